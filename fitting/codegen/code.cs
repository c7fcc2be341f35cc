@HEAD
using System;
using System.Runtime.CompilerServices;
#if UNITY_5_3_OR_NEWER
using Unity.Mathematics;
using UnityEngine;
#endif

#pragma warning disable 1718 // what is not equal to itself is no number

namespace Jaxik {

public static class @TITLE {
@MEMBERS

    /// <summary>True or false, in as many bytes as a number.</summary>
    [Serializable]
    public struct Flag {
        [Range(0, 1)]
        public int Value;
        public static implicit operator bool(Flag flag) { return flag.Value != 0; }
        public static implicit operator Flag(bool value) { return new Flag { Value = value ? 1 : 0 }; }
    }

#if !UNITY_5_3_OR_NEWER
    /* What Unity has itself. */
    public struct float3 {
        public float x, y, z;
        public float3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
    }

    public struct float4 {
        public float w, x, y, z;
    }

    public struct quaternion {
        public float4 value;
        public quaternion(float x, float y, float z, float w) {
            value = new float4 { w = w, x = x, y = y, z = z };
        }
    }

    sealed class RangeAttribute : Attribute {
        public RangeAttribute(float min, float max) { }
    }

    sealed class TooltipAttribute : Attribute {
        public TooltipAttribute(string tooltip) { }
    }

    static class math {
        public static float abs(float x) { return Math.Abs(x); }
        public static float sqrt(float x) { return (float)Math.Sqrt(x); }
        public static float exp(float x) { return (float)Math.Exp(x); }
        public static float log(float x) { return (float)Math.Log(x); }
        public static float pow(float x, float y) { return (float)Math.Pow(x, y); }
        public static float cos(float x) { return (float)Math.Cos(x); }
        public static float sin(float x) { return (float)Math.Sin(x); }
        public static float tan(float x) { return (float)Math.Tan(x); }
        public static float tanh(float x) { return (float)Math.Tanh(x); }
        public static float atan2(float y, float x) { return (float)Math.Atan2(y, x); }
        public static float floor(float x) { return (float)Math.Floor(x); }
        public static float ceil(float x) { return (float)Math.Ceiling(x); }
        public static float round(float x) { return (float)Math.Round(x); }
        public static uint asuint(float x) { return (uint)BitConverter.SingleToInt32Bits(x); }
        public static float asfloat(uint x) { return BitConverter.Int32BitsToSingle((int)x); }
    }
#endif
}

}
