"""Generated C# under Mono, as tests run it."""

# pyright: reportArgumentType=false

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from fitting.codegen.cs_code import filled, pascal
from fitting.codegen.program import Program
from fitting.codegen.toolchain import RAY, Compiled

MONO, MCS = shutil.which("mono"), shutil.which("mcs")
needs_mono = pytest.mark.skipif(
    MONO is None or MCS is None, reason="needs mono and mcs, of which one is not installed"
)
STRICT = ("-langversion:7.2", "-warn:4", "-warnaserror")
DOUBLES = "-O=-float32"
"""The option with which Mono, as older ones always do, computes floats in 64 bits."""
PLAY = """\
#pragma warning disable 219 // of rays, where there are none
using System;
using System.IO;
using System.Runtime.InteropServices;
using Jaxik;

static class Play {
    static byte[] inputs;
    static int place;

    static T[] Read<T>(int count) where T : struct {
        T[] values = new T[count];
        Span<byte> bytes = MemoryMarshal.AsBytes<T>(values);
        new ReadOnlySpan<byte>(inputs, place, bytes.Length).CopyTo(bytes);
        place += bytes.Length;
        return values;
    }

    static void Write<T>(Stream file, T[] values) where T : struct {
        byte[] bytes = MemoryMarshal.AsBytes<T>(values).ToArray();
        file.Write(bytes, 0, bytes.Length);
    }

    static void Main(string[] words) {
        inputs = File.ReadAllBytes("inputs.bin");
        bool resets = words[1] == "True";
        int count = int.Parse(words[0]), size = @TITLE.RayCount;
        bool tracked = words[2] == "True";
        @TITLE.Parameters[] allParameters = Read<@TITLE.Parameters>(tracked ? count : 1);
        @TITLE.Rig rig = Read<@TITLE.Rig>(1)[0];
        @TITLE.Frame[] frames = Read<@TITLE.Frame>(count);
        @TITLE.Hit[] allHits = Read<@TITLE.Hit>(count * size);
        @TITLE.State[] starts = Read<@TITLE.State>(resets ? count : 0);
        @TITLE.State[] states = new @TITLE.State[count];
        @TITLE.Ray[] allRays = new @TITLE.Ray[count * size];
        @TITLE.Result[] results = new @TITLE.Result[count];
        @TITLE.Work work = default(@TITLE.Work);
        @TITLE.State state;
        @TITLE.Init(in allParameters[0], in rig, out state);
        for (int i = 0; i < count; i++) {
            if (resets) state = starts[i];
            @TITLE.Parameters parameters = allParameters[tracked ? i : 0];
            @TITLE.Frame frame = frames[i];
            ReadOnlySpan<@TITLE.Hit> hits = new ReadOnlySpan<@TITLE.Hit>(allHits, i * size, size);
            Span<@TITLE.Ray> rays = new Span<@TITLE.Ray>(allRays, i * size, size);
            @TITLE.Result result;
@CALLS
            states[i] = state;
            results[i] = result;
        }
        using (Stream file = File.Create("outputs.bin")) {
            Write(file, states);
            Write(file, allRays);
            Write(file, results);
        }
    }
}
"""


class Mono(Compiled):
    """A program that `export_system` has written in C#, for `Playback`."""

    def __init__(self, program: Program, folder: Path, name: str, *options: str) -> None:
        """Takes it; it is compiled as it runs.

        Args:
            program: what `export_system` has returned.
            folder: of its file.
            name: of this.
            options: of mono.
        """
        self.program, self.folder, self.name, self.options = program, folder, name, options

    def loop(self, *pointers: Any) -> None:
        """Runs the frames, as the loop in C does."""
        places, rays = self.program.places, self.program.ray_count
        *inputs, starts, count, tracked, states, ray_words, results = pointers
        sizes = [
            len(places["parameters"]) * (count.value if tracked.value else 1),
            len(places["rig"]),
            count.value * len(places["frame"]),
            count.value * rays * (8 if self.program.platforms else 7),
        ]
        given = [*zip(inputs, sizes, strict=True)]
        if starts is not None:
            given.append((starts, count.value * len(places["state"])))
        content = b"".join(ctypes.string_at(pointer, 4 * size) for pointer, size in given)
        (self.folder / "inputs.bin").write_bytes(content)
        self._run(str(count.value), str(starts is not None), str(bool(tracked.value)))
        content, place = (self.folder / "outputs.bin").read_bytes(), 0
        row_sizes = (len(places["state"]), RAY * rays, len(places["result"]))
        for pointer, row_size in zip((states, ray_words, results), row_sizes, strict=True):
            size = 4 * count.value * row_size
            ctypes.memmove(pointer, content[place : place + size], size)
            place += size
        assert place == len(content)

    def _run(self, *words: str) -> None:
        (self.folder / "Play.cs").write_text(filled(PLAY, self.program, self.name))
        compile_code(self.folder, "Play.exe", f"{pascal(self.name)}.cs", "Play.cs")
        done = run(self.folder, *self.options, "Play.exe", *words)
        assert done.returncode == 0, done.stderr


def compile_code(folder: Path, output: str, *files: str) -> None:
    """Compiles files of a folder, without a warning."""
    command = [str(MCS), *STRICT, f"-out:{output}", *files]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """A program in a folder."""
    return subprocess.run([str(MONO), *words], cwd=folder, capture_output=True, text=True)
