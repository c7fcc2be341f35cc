/* Runs the component over frames of doubles on standard input, with bones on standard output. */
using System;
using System.IO;
using System.Reflection;
using UnityEngine;

static class Run {
    const BindingFlags Hidden = BindingFlags.Instance | BindingFlags.NonPublic | BindingFlags.Public;
    static readonly BinaryReader input = new BinaryReader(Console.OpenStandardInput());
    static readonly BinaryWriter output = new BinaryWriter(Console.OpenStandardOutput());

    static bool Read(Transform bone) {
        byte[] bytes = input.ReadBytes(56);
        if (bytes.Length < 56) return false;
        float[] n = new float[7];
        for (int i = 0; i < 7; i++) n[i] = (float)BitConverter.ToDouble(bytes, 8 * i);
        bone.localPosition = new Vector3(n[0], n[1], n[2]);
        bone.localRotation = new Quaternion(n[3], n[4], n[5], n[6]);
        return true;
    }

    static void Main() {
        FootikBehaviour component = new FootikBehaviour();
        Action<string> send = name => typeof(FootikBehaviour).GetMethod(name, Hidden).Invoke(component, null);
        Action<string, object> set = (name, value) => typeof(FootikBehaviour).GetField(name, Hidden).SetValue(component, value);
        Transform[] bones = new Transform[1 + 4 * Jaxik.Footik.LegCount];
        for (int i = 0; i < bones.Length; i++) Read(bones[i] = new Transform { parent = component.transform });
        set("pelvis", bones[0]);
        set("joints", new ArraySegment<Transform>(bones, 1, bones.Length - 1).ToArray());
        send("Awake");
        send("OnEnable");
        while (Read(component.transform)) {
            foreach (Transform bone in bones) Read(bone);
            send("LateUpdate");
            foreach (Transform bone in bones) {
                Vector3 p = bone.localPosition;
                Quaternion q = bone.localRotation;
                foreach (float number in new[] { p.x, p.y, p.z, q.x, q.y, q.z, q.w }) output.Write((double)number);
            }
        }
    }
}
