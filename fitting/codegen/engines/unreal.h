/* Foot IK in Unreal Engine 5, as a node of an animation blueprint: after everything that animates,
   before everything that simulates. It belongs to the code beside it; make it yours.

   Axes: @file.h converts x forward, y right, z up, cm. Yaw says where in its component the mesh
   faces: 90 for one that faces y, as mannequins do. The component must not be scaled.
   Root motion: the node neither makes nor takes any. Speeds come from where the component is,
   whoever moves it.
   Rays: line traces from a worker thread, onto one channel. What they hit does not move.
   Teleports: Unreal calls ResetDynamics, which restarts the memory.
   LOD: lead Alpha to 0 before LODThreshold takes the node out; call ResetDynamics afterwards. */
#pragma once
#include "Animation/AnimInstanceProxy.h"
#include "BoneControllers/AnimNode_SkeletalControlBase.h"
#include "Engine/World.h"
#include "@file.h"
#include "AnimNode_@Name.generated.h"

USTRUCT(BlueprintInternalUseOnly)
struct FAnimNode_@Name : public FAnimNode_SkeletalControlBase {
    GENERATED_BODY()
    UPROPERTY(EditAnywhere, Category = Legs) FBoneReference Pelvis;
    /** Hip, knee, ankle and ball of each leg, the left leg first. */
    UPROPERTY(EditAnywhere, Category = Legs) TArray<FBoneReference> Joints;
    UPROPERTY(EditAnywhere, Category = Legs) float Yaw = 90.0f;
    UPROPERTY(EditAnywhere, Category = Ground) TEnumAsByte<ECollisionChannel> Channel = ECC_Visibility;
    UPROPERTY(EditAnywhere, Category = Ground, meta = (PinShownByDefault)) float Grounded = 1.0f;
    @parameters parameters = @defaults;
    @rig rig;
    @state state;
    @frame frame = @blank_frame;
    bool Restart = true;

    virtual void ResetDynamics(ETeleportType) override { Restart = true; }
    virtual void UpdateInternal(const FAnimationUpdateContext& Context) override { frame.dt = Context.GetDeltaTime(); }
    virtual bool IsValidToEvaluate(const USkeleton*, const FBoneContainer& Bones) override {
        for (FBoneReference& Joint : Joints) if (!Joint.IsValidToEvaluate(Bones)) return false;
        return Joints.Num() == 4 * @NAME_LEGS && Pelvis.IsValidToEvaluate(Bones);
    }
    virtual void InitializeBoneReferences(const FBoneContainer& Bones) override {
        Pelvis.Initialize(Bones);
        for (FBoneReference& Joint : Joints) if (!Joint.Initialize(Bones)) return;
        FCompactPose Standing; // the reference pose stands on z = 0
        Standing.SetBoneContainer(&Bones);
        Standing.ResetToRefPose();
        FCSPose<FCompactPose> Pose;
        Pose.InitPose(Standing);
        if (Joints.Num() == 4 * @NAME_LEGS) ReadPose(Pose, Bones);
        @measure_rig(&frame, &rig);
    }
    virtual void EvaluateSkeletalControl_AnyThread(FComponentSpacePoseContext& Output, TArray<FBoneTransform>& Out) override {
        const FBoneContainer& Bones = Output.Pose.GetPose().GetBoneContainer();
        const FTransform Root = Facing() * Output.AnimInstanceProxy->GetComponentTransform();
        UWorld* World = Output.AnimInstanceProxy->GetSkelMeshComponent()->GetWorld();
        const FCollisionQueryParams Query(NAME_None, false, Output.AnimInstanceProxy->GetSkelMeshComponent()->GetOwner());
        const @frame before = frame;
        @work work;
        @ray rays[@NAME_RAYS];
        @hit hits[@NAME_RAYS];
        @result result;
        ReadPose(Output.Pose, Bones);
        Theirs(Root, frame.world_from_model.pos, frame.world_from_model.rot);
        if (Restart) @init(&parameters, &rig, &state);
        @measure_speeds(Restart ? &frame : &before, &frame);
        frame.grounded = Grounded;
        Restart = false;
        const auto cast = [&](int First, int End) {
            for (int i = First; i < End; i++) {
                float from[3], along[3];
                @point_to_unreal(rays[i].origin, from), @direction_to_unreal(rays[i].direction, along);
                const FVector Start(from[0], from[1], from[2]), Along(along[0], along[1], along[2]);
                FHitResult Hit;
                hits[i].found = World->LineTraceSingleByChannel(Hit, Start, Start + 100.0 * rays[i].length * Along, Channel, Query);
                const float point[3] = {float(Hit.ImpactPoint.X), float(Hit.ImpactPoint.Y), float(Hit.ImpactPoint.Z)};
                const float normal[3] = {float(Hit.ImpactNormal.X), float(Hit.ImpactNormal.Y), float(Hit.ImpactNormal.Z)};
                @point_from_unreal(point, hits[i].point), @direction_from_unreal(normal, hits[i].normal);@STILL
            }
        };
@CASTING
        const auto Write = [&](FBoneReference& Bone, const FTransform& Transform) {
            Out.Add(FBoneTransform(Bone.GetCompactPoseIndex(Bones), Transform * Facing()));
        };
        const FTransform Hips = Output.Pose.GetComponentSpaceTransform(Pelvis.GetCompactPoseIndex(Bones));
        Write(Pelvis, Hips.GetRelativeTransform(Facing()) * Ours(result.body.pos, result.body.rot));
        EachJoint(result.pose, [&](int i, float* pos, float* rot) { Write(Joints[i], Ours(pos, rot)); });
        Out.Sort(FCompareBoneTransformIndex());
    }

    FTransform Facing() const { return FTransform(FQuat(FVector::UpVector, FMath::DegreesToRadians(Yaw))); }
    void ReadPose(FCSPose<FCompactPose>& Pose, const FBoneContainer& Bones) {
        EachJoint(frame.pose, [&](int i, float* pos, float* rot) {
            const FTransform Joint = Pose.GetComponentSpaceTransform(Joints[i].GetCompactPoseIndex(Bones));
            Theirs(Joint.GetRelativeTransform(Facing()), pos, rot);
        });
    }
    template <class Legs, class Action> static void EachJoint(Legs& legs, Action act) {
        for (int i = 0; i < @NAME_LEGS; i++) {
            act(4 * i, legs.hip.pos[i], legs.hip.rot[i]), act(4 * i + 1, legs.knee.pos[i], legs.knee.rot[i]);
            act(4 * i + 2, legs.ankle.pos[i], legs.ankle.rot[i]), act(4 * i + 3, legs.toe.pos[i], legs.toe.rot[i]);
        }
    }
    static FTransform Ours(const float* pos, const float* rot) {
        float p[3], q[4];
        @point_to_unreal(pos, p), @rotation_to_unreal(rot, q);
        return FTransform(FQuat(q[0], q[1], q[2], q[3]), FVector(p[0], p[1], p[2]));
    }
    static void Theirs(const FTransform& Joint, float* pos, float* rot) {
        const FVector P = Joint.GetTranslation();
        const FQuat Q = Joint.GetRotation();
        const float p[3] = {float(P.X), float(P.Y), float(P.Z)};
        const float q[4] = {float(Q.X), float(Q.Y), float(Q.Z), float(Q.W)};
        @point_from_unreal(p, pos), @rotation_from_unreal(q, rot);
    }
};
