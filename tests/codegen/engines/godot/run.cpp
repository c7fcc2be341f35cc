/* Runs the modifier over frames of doubles on standard input, with bones on standard output. */
#include <cstdio>

#include "footik_modifier.cpp"

static bool read(Transform3D &bone) {
    double n[7];
    const bool there = fread(n, sizeof n, 1, stdin) == 1;
    bone = Transform3D(Quaternion(n[3], n[4], n[5], n[6]), Vector3(n[0], n[1], n[2]));
    return there;
}

int main() {
    Footik node;
    PackedStringArray names;
    Skeleton3D &skeleton = *node.get_skeleton();
    skeleton.rest.resize(1 + 4 * FOOTIK_LEGS), skeleton.pose.resize(skeleton.rest.size());
    for (Transform3D &bone : skeleton.rest) {
        read(bone);
        names.push_back(std::to_string(names.size()));
    }
    node.set_bones(names);
    while (read(skeleton.place)) {
        for (Transform3D &bone : skeleton.pose) read(bone);
        node._process_modification();
        for (const Transform3D &bone : skeleton.pose) {
            const Quaternion q = bone.basis.q;
            const double n[7] = {bone.origin.x, bone.origin.y, bone.origin.z, q.x, q.y, q.z, q.w};
            fwrite(n, sizeof n, 1, stdout);
        }
    }
}
