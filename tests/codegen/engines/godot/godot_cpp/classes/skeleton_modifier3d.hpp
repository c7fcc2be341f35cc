/* As much of Godot as the modifier for it needs, to compile and run it in tests. */
#pragma once
#include <cmath>
#include <cstdint>
#include <map>
#include <string>
#include <vector>

#define GDCLASS(name, base)
#define D_METHOD(...) 0
#define ADD_PROPERTY(...)
#define PropertyInfo(...)

namespace godot {
struct Vector3 {
    float x = 0, y = 0, z = 0;
    Vector3() {}
    Vector3(float a, float b, float c) : x(a), y(b), z(c) {}
    float operator[](int axis) const { return axis == 0 ? x : axis == 1 ? y : z; }
    Vector3 operator+(const Vector3 &o) const { return Vector3(x + o.x, y + o.y, z + o.z); }
    Vector3 operator-() const { return Vector3(-x, -y, -z); }
    Vector3 cross(const Vector3 &o) const { return Vector3(y * o.z - z * o.y, z * o.x - x * o.z, x * o.y - y * o.x); }
};
inline Vector3 operator*(float s, const Vector3 &v) { return Vector3(s * v.x, s * v.y, s * v.z); }
struct Quaternion {
    float x = 0, y = 0, z = 0, w = 1;
    Quaternion() {}
    Quaternion(float a, float b, float c, float d) : x(a), y(b), z(c), w(d) {}
};
struct Basis { // kept as a quaternion
    Quaternion q;
    Basis() {}
    Basis(const Quaternion &rotation) : q(rotation) {}
    Quaternion get_rotation_quaternion() const { return q; }
};
struct Transform3D {
    Basis basis;
    Vector3 origin;
    Transform3D() {}
    Transform3D(const Basis &b, const Vector3 &o) : basis(b), origin(o) {}
    Transform3D operator*(const Transform3D &o) const { // first o, then this
        const Quaternion a = basis.q, b = o.basis.q;
        const Vector3 axis(a.x, a.y, a.z), t = 2.0f * axis.cross(o.origin);
        const Quaternion turn(a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y, a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
                              a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w, a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z);
        return Transform3D(turn, origin + o.origin + a.w * t + axis.cross(t));
    }
};
typedef std::string String;
typedef std::vector<String> PackedStringArray;
struct ClassDB {
    template <class Method> static void bind_method(int, Method) {}
};
struct Dictionary : std::map<String, Vector3> {
    bool is_empty() const { return empty(); }
    Vector3 get(const String &key, const Vector3 &otherwise) const { return empty() ? otherwise : at(key); }
};
struct PhysicsRayQueryParameters3D {
    Vector3 from, to;
    static PhysicsRayQueryParameters3D create(const Vector3 &from, const Vector3 &to, uint32_t) {
        PhysicsRayQueryParameters3D query;
        query.from = from, query.to = to;
        return query;
    }
};
struct PhysicsDirectSpaceState3D { // a slope across x
    Dictionary intersect_ray(const PhysicsRayQueryParameters3D &query) const {
        const float slope = 0.1f, above = query.from.y - slope * query.from.x, below = query.to.y - slope * query.to.x;
        Dictionary hit;
        if (above < 0 || below > 0) return hit;
        hit["position"] = query.from + (above / (above - below)) * (query.to + -query.from);
        hit["normal"] = 1.0f / std::sqrt(1 + slope * slope) * Vector3(-slope, 1, 0);
        return hit;
    }
};
struct World3D {
    PhysicsDirectSpaceState3D space;
    PhysicsDirectSpaceState3D *get_direct_space_state() { return &space; }
};
struct Skeleton3D {
    std::vector<Transform3D> rest, pose;
    Transform3D place;
    int find_bone(const String &name) const { return std::stoi(name); }
    Transform3D get_bone_global_rest(int bone) const { return rest[bone]; }
    Transform3D get_bone_global_pose(int bone) const { return pose[bone]; }
    void set_bone_global_pose(int bone, const Transform3D &to) { pose[bone] = to; }
    Transform3D get_global_transform() const { return place; }
};
struct SkeletonModifier3D {
    Skeleton3D skeleton;
    World3D world;
    Skeleton3D *get_skeleton() { return &skeleton; }
    World3D *get_world_3d() { return &world; }
    double get_physics_process_delta_time() const { return 1.0 / 30; }
    virtual void _process_modification() {}
    virtual ~SkeletonModifier3D() {}
};
} // namespace godot
