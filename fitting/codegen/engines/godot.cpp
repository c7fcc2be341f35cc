/* Foot IK in Godot 4.3 or newer, as a GDExtension: a child of a Skeleton3D, which runs it after the
   AnimationMixer. It belongs to the code beside it; make it yours.

   Axes: Godot's world and models have ours (Vector3.MODEL_LEFT, up, MODEL_FRONT, m); quaternions
   are turned into w x y z. The skeleton must not be scaled.
   Root motion: the node neither makes nor takes any. Speeds come from where the skeleton is,
   whoever moves it.
   Rays: the mixer's callback_mode_process must be physics, the only time when Godot allows them.
   What they hit does not move.
   Teleports: call restart().
   LOD: lead influence to 0, then set active to false; call restart() when it is true again. */
#include <godot_cpp/classes/physics_direct_space_state3d.hpp>
#include <godot_cpp/classes/physics_ray_query_parameters3d.hpp>
#include <godot_cpp/classes/skeleton3d.hpp>
#include <godot_cpp/classes/skeleton_modifier3d.hpp>
#include <godot_cpp/classes/world3d.hpp>
#include "@file.h"
using namespace godot;

class @Name : public SkeletonModifier3D {
    GDCLASS(@Name, SkeletonModifier3D)
    @parameters parameters = @defaults;
    @rig rig;
    @state state;
    @frame frame = @blank_frame;
    bool starts = true;
    PackedStringArray bones; // the pelvis; then hip, knee, ankle and ball of each leg, left first

protected:
    static void _bind_methods() {
        ClassDB::bind_method(D_METHOD("restart"), &@Name::restart);
        ClassDB::bind_method(D_METHOD("set_bones", "names"), &@Name::set_bones);
        ClassDB::bind_method(D_METHOD("get_bones"), &@Name::get_bones);
        ADD_PROPERTY(PropertyInfo(Variant::PACKED_STRING_ARRAY, "bones"), "set_bones", "get_bones");
    }

public:
    void restart() { starts = true; }
    void set_bones(const PackedStringArray &names) { bones = names, starts = true; }
    PackedStringArray get_bones() const { return bones; }

    void _process_modification() override {
        Skeleton3D *skeleton = get_skeleton();
        if (!skeleton || bones.size() != 1 + 4 * @NAME_LEGS) return;
        if (starts) { // the rest pose stands on the floor
            each_joint(frame.pose, [&](int i, float *pos, float *rot) {
                theirs(skeleton->get_bone_global_rest(skeleton->find_bone(bones[i])), pos, rot);
            });
            @measure_rig(&frame, &rig);
            @init(&parameters, &rig, &state);
        }
        const @frame before = frame;
        @work work;
        @ray rays[@NAME_RAYS];
        @hit hits[@NAME_RAYS];
        @result result;
        each_joint(frame.pose, [&](int i, float *pos, float *rot) {
            theirs(skeleton->get_bone_global_pose(skeleton->find_bone(bones[i])), pos, rot);
        });
        theirs(skeleton->get_global_transform(), frame.world_from_model.pos, frame.world_from_model.rot);
        frame.dt = float(get_physics_process_delta_time());
        @measure_speeds(starts ? &frame : &before, &frame);
        starts = false;
        PhysicsDirectSpaceState3D *space = get_world_3d()->get_direct_space_state();
        const auto cast = [&](int first, int end) {
            for (int i = first; i < end; i++) {
                const Vector3 from(rays[i].origin[0], rays[i].origin[1], rays[i].origin[2]);
                const Vector3 along(rays[i].direction[0], rays[i].direction[1], rays[i].direction[2]);
                const Vector3 to = from + rays[i].length * along;
                const Dictionary hit = space->intersect_ray(PhysicsRayQueryParameters3D::create(from, to, rays[i].layers));
                const Vector3 point = hit.get("position", from), normal = hit.get("normal", -along);
                hits[i].found = hit.is_empty() ? 0.0f : 1.0f;
                for (int axis = 0; axis < 3; axis++) hits[i].point[axis] = float(point[axis]), hits[i].normal[axis] = float(normal[axis]);@STILL
            }
        };
@CASTING
        const int pelvis = skeleton->find_bone(bones[0]);
        skeleton->set_bone_global_pose(pelvis, ours(result.body.pos, result.body.rot) * skeleton->get_bone_global_pose(pelvis));
        each_joint(result.pose, [&](int i, float *pos, float *rot) { // parents first
            skeleton->set_bone_global_pose(skeleton->find_bone(bones[i]), ours(pos, rot));
        });
    }

private:
    template <class Legs, class Action> static void each_joint(Legs &legs, Action act) {
        for (int i = 0; i < @NAME_LEGS; i++) {
            act(4 * i + 1, legs.hip.pos[i], legs.hip.rot[i]), act(4 * i + 2, legs.knee.pos[i], legs.knee.rot[i]);
            act(4 * i + 3, legs.ankle.pos[i], legs.ankle.rot[i]), act(4 * i + 4, legs.toe.pos[i], legs.toe.rot[i]);
        }
    }
    static Transform3D ours(const float *pos, const float *rot) {
        float p[3], q[4];
        @point_to_godot(pos, p), @rotation_to_godot(rot, q);
        return Transform3D(Basis(Quaternion(q[0], q[1], q[2], q[3])), Vector3(p[0], p[1], p[2]));
    }
    static void theirs(const Transform3D &joint, float *pos, float *rot) {
        const Vector3 p = joint.origin;
        const Quaternion q = joint.basis.get_rotation_quaternion();
        const float place[3] = {float(p.x), float(p.y), float(p.z)};
        const float turn[4] = {float(q.x), float(q.y), float(q.z), float(q.w)};
        @point_from_godot(place, pos), @rotation_from_godot(turn, rot);
    }
};
