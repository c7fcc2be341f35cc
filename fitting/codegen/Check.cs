/* Replays a golden trace, whose numbers come from jaxik.step in Python:

       mcs -out:Check.exe @TITLE.cs Check.cs && mono Check.exe trace.bin

   It ends with 0 if rays and results are as in the trace, but for rounding. */
using System;
using System.IO;
using System.Runtime.InteropServices;

namespace Jaxik {

static class Check {
    static byte[] trace;
    static int place; /* in the trace */
    static float worst; /* difference so far */

    static T[] Read<T>(int count) where T : struct {
        T[] values = new T[count];
        Span<byte> bytes = MemoryMarshal.AsBytes<T>(values);
        new ReadOnlySpan<byte>(trace, place, bytes.Length).CopyTo(bytes);
        place += bytes.Length;
        return values;
    }

    static void Compare<T>(T[] ours, T[] theirs) where T : struct {
        ReadOnlySpan<uint> a = MemoryMarshal.Cast<T, uint>(ours), b = MemoryMarshal.Cast<T, uint>(theirs);
        ReadOnlySpan<float> x = MemoryMarshal.Cast<T, float>(ours), y = MemoryMarshal.Cast<T, float>(theirs);
        for (int i = 0; i < a.Length; i++) {
            if (a[i] == b[i]) continue;
            float difference = (a[i] | b[i]) < 2 ? 1f : Math.Abs(x[i] - y[i]);
            if (!(difference <= worst)) worst = difference;
        }
    }

    static int Main(string[] words) {
        trace = File.ReadAllBytes(words.Length > 0 ? words[0] : "trace.bin");
        @TITLE.Parameters parameters = Read<@TITLE.Parameters>(1)[0];
        @TITLE.Rig rig = Read<@TITLE.Rig>(1)[0];
        @TITLE.Ray[] rays = new @TITLE.Ray[@TITLE.RayCount];
        @TITLE.Work work = default(@TITLE.Work);
        @TITLE.State state;
        @TITLE.Init(in parameters, in rig, out state);
        int frames = 0;
        for (; place < trace.Length; frames++) {
            @TITLE.Frame frame = Read<@TITLE.Frame>(1)[0];
            @TITLE.Ray[] wanted = Read<@TITLE.Ray>(@TITLE.RayCount);
            @TITLE.Hit[] hits = Read<@TITLE.Hit>(@TITLE.RayCount);
            @TITLE.Result[] expected = Read<@TITLE.Result>(1);
            @TITLE.Result result;
@CALLS
            Compare(rays, wanted);
            Compare(new[] { result }, expected);
        }
        Console.WriteLine($"{frames} frames, largest difference {worst:g6}");
        return frames > 0 && worst <= 1e-4f ? 0 : 1;
    }
}

}
