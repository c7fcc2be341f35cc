/* As much of Unreal Engine's animation as the node for it needs, to compile and run it in tests. */
#pragma once
#include <cmath>
#include <map>
#include <vector>

#define USTRUCT(...)
#define UPROPERTY(...)
#define GENERATED_BODY()
#define NAME_None 0
enum ECollisionChannel { ECC_Visibility };
enum class ETeleportType { None, ResetPhysics };
template <class T> struct TEnumAsByte {
    T value;
    TEnumAsByte(T v) : value(v) {}
    operator T() const { return value; }
};
template <class T> struct TArray : std::vector<T> {
    int Num() const { return int(this->size()); }
    void Add(const T& item) { this->push_back(item); }
    template <class Compare> void Sort(Compare) {}
};
struct FMath {
    static float DegreesToRadians(float degrees) { return degrees * 0.017453292519943295f; }
};

struct FVector {
    double X = 0, Y = 0, Z = 0;
    FVector() {}
    FVector(double x, double y, double z) : X(x), Y(y), Z(z) {}
    static const FVector UpVector;
    FVector operator+(const FVector& o) const { return FVector(X + o.X, Y + o.Y, Z + o.Z); }
    FVector operator-(const FVector& o) const { return FVector(X - o.X, Y - o.Y, Z - o.Z); }
    FVector operator^(const FVector& o) const { return FVector(Y * o.Z - Z * o.Y, Z * o.X - X * o.Z, X * o.Y - Y * o.X); }
};
inline FVector operator*(double s, const FVector& v) { return FVector(s * v.X, s * v.Y, s * v.Z); }
inline const FVector FVector::UpVector(0, 0, 1);

struct FQuat {
    double X = 0, Y = 0, Z = 0, W = 1;
    FQuat() {}
    FQuat(double x, double y, double z, double w) : X(x), Y(y), Z(z), W(w) {}
    FQuat(const FVector& axis, double angle) : W(std::cos(angle / 2)) {
        const double s = std::sin(angle / 2);
        X = s * axis.X, Y = s * axis.Y, Z = s * axis.Z;
    }
    FQuat Inverse() const { return FQuat(-X, -Y, -Z, W); }
    FQuat operator*(const FQuat& o) const { // first o, then this
        return FQuat(W * o.X + X * o.W + Y * o.Z - Z * o.Y, W * o.Y - X * o.Z + Y * o.W + Z * o.X,
                     W * o.Z + X * o.Y - Y * o.X + Z * o.W, W * o.W - X * o.X - Y * o.Y - Z * o.Z);
    }
    FVector RotateVector(const FVector& v) const {
        const FVector q(X, Y, Z), t = 2.0 * (q ^ v);
        return v + W * t + (q ^ t);
    }
};

struct FTransform {
    FQuat rotation;
    FVector translation;
    FTransform() {}
    explicit FTransform(const FQuat& q, const FVector& p = FVector()) : rotation(q), translation(p) {}
    FQuat GetRotation() const { return rotation; }
    FVector GetTranslation() const { return translation; }
    FTransform operator*(const FTransform& o) const { // first this, then o
        return FTransform(o.rotation * rotation, o.rotation.RotateVector(translation) + o.translation);
    }
    FTransform GetRelativeTransform(const FTransform& o) const {
        const FQuat back = o.rotation.Inverse();
        return FTransform(back * rotation, back.RotateVector(translation - o.translation));
    }
};

struct FBoneContainer {};
struct USkeleton {};
struct FBoneReference {
    int index;
    bool Initialize(const FBoneContainer&) { return true; }
    bool IsValidToEvaluate(const FBoneContainer&) const { return true; }
    int GetCompactPoseIndex(const FBoneContainer&) const { return index; }
};
struct FBoneTransform {
    int BoneIndex;
    FTransform Transform;
    FBoneTransform(int index, const FTransform& transform) : BoneIndex(index), Transform(transform) {}
};
struct FCompareBoneTransformIndex {};
struct FCompactPose {
    static std::vector<FTransform> reference; // in the component's space
    std::vector<FTransform> bones;
    void SetBoneContainer(const FBoneContainer*) {}
    void ResetToRefPose() { bones = reference; }
    FBoneContainer GetBoneContainer() const { return FBoneContainer(); }
};
template <class T> struct FCSPose {
    T pose;
    void InitPose(const T& other) { pose = other; }
    const T& GetPose() const { return pose; }
    FTransform GetComponentSpaceTransform(int index) const { return pose.bones[index]; }
};

struct FHitResult {
    FVector ImpactPoint, ImpactNormal;
};
struct AActor {};
struct FCollisionQueryParams {
    FCollisionQueryParams(int, bool, const AActor*) {}
};
struct UWorld { // a slope across y
    bool LineTraceSingleByChannel(FHitResult& hit, const FVector& start, const FVector& end, ECollisionChannel, const FCollisionQueryParams&) const {
        const double slope = 0.1, above = start.Z - slope * start.Y, below = end.Z - slope * end.Y;
        if (above < 0 || below > 0) return false;
        hit.ImpactPoint = start + (above / (above - below)) * (end - start);
        const double length = std::sqrt(1 + slope * slope);
        hit.ImpactNormal = FVector(0, -slope / length, 1 / length);
        return true;
    }
};
struct USkeletalMeshComponent {
    UWorld world;
    AActor owner;
    UWorld* GetWorld() { return &world; }
    AActor* GetOwner() { return &owner; }
};
struct FAnimInstanceProxy {
    USkeletalMeshComponent component;
    FTransform to_world;
    USkeletalMeshComponent* GetSkelMeshComponent() { return &component; }
    const FTransform& GetComponentTransform() const { return to_world; }
};
struct FComponentSpacePoseContext {
    FAnimInstanceProxy* AnimInstanceProxy;
    FCSPose<FCompactPose> Pose;
};
struct FAnimationUpdateContext {
    float delta;
    float GetDeltaTime() const { return delta; }
};
struct FAnimNode_SkeletalControlBase {
    virtual ~FAnimNode_SkeletalControlBase() {}
    virtual void ResetDynamics(ETeleportType) {}
    virtual void UpdateInternal(const FAnimationUpdateContext&) {}
    virtual bool IsValidToEvaluate(const USkeleton*, const FBoneContainer&) { return true; }
    virtual void InitializeBoneReferences(const FBoneContainer&) {}
    virtual void EvaluateSkeletalControl_AnyThread(FComponentSpacePoseContext&, TArray<FBoneTransform>&) {}
};
