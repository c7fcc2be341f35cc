/* As much of Unity as the component for it needs, to compile and run it in tests. */
using System;
using Unity.Mathematics;

namespace Unity.Mathematics {
public struct float3 {
    public float x, y, z;
    public float3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
    public static implicit operator UnityEngine.Vector3(float3 v) { return new UnityEngine.Vector3(v.x, v.y, v.z); }
    public static implicit operator float3(UnityEngine.Vector3 v) { return new float3(v.x, v.y, v.z); }
}

public struct float4 {
    public float x, y, z, w;
}

public struct quaternion {
    public float4 value;
    public quaternion(float x, float y, float z, float w) { value = new float4 { x = x, y = y, z = z, w = w }; }
    public static implicit operator UnityEngine.Quaternion(quaternion q) {
        return new UnityEngine.Quaternion(q.value.x, q.value.y, q.value.z, q.value.w);
    }
    public static implicit operator quaternion(UnityEngine.Quaternion q) { return new quaternion(q.x, q.y, q.z, q.w); }
}

public static class math {
    public static float abs(float x) { return Math.Abs(x); }
    public static float sqrt(float x) { return (float)Math.Sqrt(x); }
    public static float exp(float x) { return (float)Math.Exp(x); }
    public static float cos(float x) { return (float)Math.Cos(x); }
    public static float sin(float x) { return (float)Math.Sin(x); }
    public static float atan2(float y, float x) { return (float)Math.Atan2(y, x); }
    public static float round(float x) { return (float)Math.Round(x); }
    public static uint asuint(float x) { return (uint)BitConverter.SingleToInt32Bits(x); }
    public static float asfloat(uint x) { return BitConverter.Int32BitsToSingle((int)x); }
}
}

namespace UnityEngine {
public struct Vector3 {
    public float x, y, z;
    public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
    public static Vector3 operator +(Vector3 a, Vector3 b) { return new Vector3(a.x + b.x, a.y + b.y, a.z + b.z); }
    public static Vector3 operator -(Vector3 a, Vector3 b) { return new Vector3(a.x - b.x, a.y - b.y, a.z - b.z); }
    public static Vector3 operator *(float s, Vector3 a) { return new Vector3(s * a.x, s * a.y, s * a.z); }
    public static Vector3 Cross(Vector3 a, Vector3 b) {
        return new Vector3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
    }
}

public struct Quaternion {
    public float x, y, z, w;
    public Quaternion(float x, float y, float z, float w) { this.x = x; this.y = y; this.z = z; this.w = w; }
    public static Quaternion Inverse(Quaternion q) { return new Quaternion(-q.x, -q.y, -q.z, q.w); }
    public static Quaternion operator *(Quaternion a, Quaternion b) {
        return new Quaternion(
            a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y, a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
            a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w, a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z);
    }
    public static Vector3 operator *(Quaternion q, Vector3 v) {
        Vector3 axis = new Vector3(q.x, q.y, q.z), t = 2f * Vector3.Cross(axis, v);
        return v + q.w * t + Vector3.Cross(axis, t);
    }
}

public class Transform {
    public Transform parent;
    public Vector3 localPosition;
    public Quaternion localRotation = new Quaternion(0f, 0f, 0f, 1f);
    public Vector3 position { get { return parent == null ? localPosition : parent.TransformPoint(localPosition); } }
    public Quaternion rotation { get { return parent == null ? localRotation : parent.rotation * localRotation; } }
    public Vector3 TransformPoint(Vector3 point) { return position + rotation * point; }
    public Vector3 InverseTransformPoint(Vector3 point) { return Quaternion.Inverse(rotation) * (point - position); }
    public void SetPositionAndRotation(Vector3 pos, Quaternion rot) {
        localPosition = parent.InverseTransformPoint(pos);
        localRotation = Quaternion.Inverse(parent.rotation) * rot;
    }
}

public class MonoBehaviour {
    public readonly Transform transform = new Transform();
}

public struct LayerMask {
    int value;
    public static implicit operator int(LayerMask mask) { return mask.value; }
    public static implicit operator LayerMask(int value) { return new LayerMask { value = value }; }
}

public struct RaycastHit {
    public Vector3 point, normal;
}

public enum QueryTriggerInteraction { Ignore }

public static class Physics { // a slope, up to the right
    public const float Slope = 0.1f;
    public static bool Raycast(
        Vector3 from, Vector3 along, out RaycastHit hit, float length, int layers, QueryTriggerInteraction triggers
    ) {
        float way = (from.y - Slope * from.x) / (Slope * along.x - along.y), steep = 1f / (float)Math.Sqrt(1f + Slope * Slope);
        hit = new RaycastHit { point = from + way * along, normal = new Vector3(-steep * Slope, steep, 0f) };
        return layers != 0 && way >= 0f && way <= length;
    }
}

public static class Time {
    public const float deltaTime = 1f / 30;
}

public class SerializeField : Attribute { }

public class DefaultExecutionOrder : Attribute {
    public DefaultExecutionOrder(int order) { }
}

public class TooltipAttribute : Attribute {
    public TooltipAttribute(string tooltip) { }
}

public class RangeAttribute : Attribute {
    public RangeAttribute(float min, float max) { }
}
}
