/* Runs the node over frames of doubles on standard input, with bones on standard output. */
#include <cstdio>

#include "AnimNode_Footik.h"

std::vector<FTransform> FCompactPose::reference;

static bool read(FTransform& bone) {
    double n[7];
    const bool there = fread(n, sizeof n, 1, stdin) == 1;
    bone = FTransform(FQuat(n[3], n[4], n[5], n[6]), FVector(n[0], n[1], n[2]));
    return there;
}

int main() {
    const int bones = 1 + 4 * FOOTIK_LEGS;
    FAnimNode_Footik node;
    FAnimInstanceProxy proxy;
    FComponentSpacePoseContext context = {&proxy, {}};
    FCompactPose::reference.resize(bones), context.Pose.pose.bones.resize(bones);
    for (FTransform& bone : FCompactPose::reference) read(bone);
    node.Pelvis = FBoneReference{0};
    for (int i = 1; i < bones; i++) node.Joints.Add(FBoneReference{i});
    node.InitializeBoneReferences(FBoneContainer());
    if (!node.IsValidToEvaluate(nullptr, FBoneContainer())) return 1;
    while (read(proxy.to_world)) {
        TArray<FBoneTransform> out;
        for (FTransform& bone : context.Pose.pose.bones) read(bone);
        node.UpdateInternal(FAnimationUpdateContext{1.0f / 30});
        node.EvaluateSkeletalControl_AnyThread(context, out);
        for (const FBoneTransform& bone : out) {
            const FVector p = bone.Transform.GetTranslation();
            const FQuat q = bone.Transform.GetRotation();
            const double n[7] = {p.X, p.Y, p.Z, q.X, q.Y, q.Z, q.W};
            fwrite(n, sizeof n, 1, stdout);
        }
    }
}
