/* Foot IK in Unity 2021.2 or newer, with com.unity.mathematics: a component beside an Animator. It
   belongs to the code beside it; make it yours.

   Axes: @TITLE.cs converts x right, y up, z forward, m. The object must face its z, unscaled.
   Root motion: the component neither makes nor takes any. Speeds come from where the object is,
   whoever moves it.
   Rays: Physics.Raycast, one by one; for many characters, fill a RaycastCommand from each ray and
   schedule a round as one batch. What they hit does not move.
   Teleports: call Restart.
   LOD: lead weight to 0, then disable the component; enabling it restarts the memory. */
using Jaxik;
using Unity.Mathematics;
using UnityEngine;

[DefaultExecutionOrder(1000)] // after everything that animates
public sealed class @TITLEBehaviour : MonoBehaviour {
    [SerializeField] Transform pelvis;
    [SerializeField, Tooltip("Hip, knee, ankle and ball of each leg, the left leg first.")]
    Transform[] joints = new Transform[4 * @TITLE.LegCount];
    [SerializeField, Tooltip("Without the layers of characters.")] LayerMask ground = ~0;
    [Range(0f, 1f)] public float weight = 1f, grounded = 1f;
    public @TITLE.Parameters parameters = @TITLE.Defaults;
    @TITLE.Rig rig;
    @TITLE.State state;
    @TITLE.Frame frame = @TITLE.BlankFrame;
    @TITLE.Work work;
    readonly @TITLE.Ray[] rays = new @TITLE.Ray[@TITLE.RayCount];
    readonly @TITLE.Hit[] hits = new @TITLE.Hit[@TITLE.RayCount];
    bool restart;

    public void Restart() => restart = true;
    void OnEnable() => Restart();

    void Awake() { // before the Animator moves it, the character stands as it was imported
        ReadPose();
        @TITLE.MeasureRig(in frame, out rig);
    }

    void LateUpdate() { // after the Animator and its root motion
        @TITLE.Frame before = frame;
        ReadPose();
        frame.WorldFromModel.Pos = @TITLE.PointFromUnity(transform.position);
        frame.WorldFromModel.Rot = @TITLE.RotationFromUnity(transform.rotation);
        frame.Grounded = grounded;
        frame.Dt = Time.deltaTime;
        @TITLE.MeasureSpeeds(restart ? frame : before, ref frame);
        if (restart) @TITLE.Init(in parameters, in rig, out state);
        restart = false;
        @TITLE.Result result;
@CASTING
        Quaternion turn = @TITLE.RotationToUnity(result.Body.Rot);
        Vector3 move = @TITLE.PointToUnity(result.Body.Pos), pos = transform.InverseTransformPoint(pelvis.position);
        Move(pelvis, move + turn * pos, turn * (Quaternion.Inverse(transform.rotation) * pelvis.rotation));
        for (int leg = 0; leg < @TITLE.LegCount; leg++) { // parents first
            Write(joints[4 * leg], result.Pose.Hip.Pos[leg], result.Pose.Hip.Rot[leg]);
            Write(joints[4 * leg + 1], result.Pose.Knee.Pos[leg], result.Pose.Knee.Rot[leg]);
            Write(joints[4 * leg + 2], result.Pose.Ankle.Pos[leg], result.Pose.Ankle.Rot[leg]);
            Write(joints[4 * leg + 3], result.Pose.Toe.Pos[leg], result.Pose.Toe.Rot[leg]);
        }
    }

    void Cast(int first, int end) {
        for (int i = first; i < end; i++) {
            Vector3 from = @TITLE.PointToUnity(rays[i].Origin), along = @TITLE.DirectionToUnity(rays[i].Direction);
            int layers = ground & (int)rays[i].Layers;
            RaycastHit hit;
            bool found = Physics.Raycast(from, along, out hit, rays[i].Length, layers, QueryTriggerInteraction.Ignore);
            hits[i].Found = found ? 1f : 0f;
            hits[i].Point = @TITLE.PointFromUnity(hit.point);
            hits[i].Normal = @TITLE.DirectionFromUnity(hit.normal);@STILL
        }
    }

    void ReadPose() {
        for (int leg = 0; leg < @TITLE.LegCount; leg++) {
            frame.Weight[leg] = weight;
            (frame.Pose.Hip.Pos[leg], frame.Pose.Hip.Rot[leg]) = Read(joints[4 * leg]);
            (frame.Pose.Knee.Pos[leg], frame.Pose.Knee.Rot[leg]) = Read(joints[4 * leg + 1]);
            (frame.Pose.Ankle.Pos[leg], frame.Pose.Ankle.Rot[leg]) = Read(joints[4 * leg + 2]);
            (frame.Pose.Toe.Pos[leg], frame.Pose.Toe.Rot[leg]) = Read(joints[4 * leg + 3]);
        }
    }

    (float3, quaternion) Read(Transform joint) => (
        @TITLE.PointFromUnity(transform.InverseTransformPoint(joint.position)),
        @TITLE.RotationFromUnity(Quaternion.Inverse(transform.rotation) * joint.rotation));

    void Write(Transform joint, float3 pos, quaternion rot) => Move(joint, @TITLE.PointToUnity(pos), @TITLE.RotationToUnity(rot));

    void Move(Transform bone, Vector3 pos, Quaternion rot) => // in the space of the object
        bone.SetPositionAndRotation(transform.TransformPoint(pos), transform.rotation * rot);
}
