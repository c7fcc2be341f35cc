/* Foot IK in an engine of one's own, as short as it can be: the animation of trace.bin walks over
   a wavy field, and its ankles are printed. Compare with your renderer:

       cc -O2 @file.c walk.c -lm -o walk && ./walk

   Call it once a frame for each character: after the animation, before physics and skinning.
   Axes: x left, y up, z forward in model space, right-handed, metres; --axes adds conversions.
   Root motion: world_from_model is where the animation and your game have put the character.
   @measure_rig measures the legs of a standing pose, @measure_speeds the speeds of a frame from
   the one before; here both come from the trace.
   Teleports: set frame.restart for that frame. LOD: lead weight to 0, then leave the calls out. */
#include <math.h>
#include <stdio.h>

#include "@file.h"

static float height(float x, float z) { return 0.06f * sinf(2.0f * x) + 0.05f * cosf(3.0f * z); }

static @ray rays[@NAME_RAYS];
static @hit hits[@NAME_RAYS];

/* Steps down a ray until it is below the field; a real engine has something better. */
static void cast(int first, int end) {
    int i, axis;
    for (i = first; i < end; i++) {
        const @ray *ray = &rays[i];
        @hit *hit = &hits[i];
        float low = 0.0f, high = 0.0f, x, z;
        for (hit->found = 0.0f; high < ray->length && !hit->found; ) {
            low = high, high = fminf(high + 0.02f, ray->length);
            x = ray->origin[0] + high * ray->direction[0], z = ray->origin[2] + high * ray->direction[2];
            hit->found = ray->origin[1] + high * ray->direction[1] <= height(x, z);
        }
        for (axis = 0; axis < 3; axis++) hit->point[axis] = ray->origin[axis] + high * ray->direction[axis];
        x = hit->point[0], z = hit->point[2];
        hit->point[1] = height(x, z);
        hit->normal[0] = -0.12f * cosf(2.0f * x), hit->normal[1] = 1.0f, hit->normal[2] = 0.15f * sinf(3.0f * z);
        low = sqrtf(hit->normal[0] * hit->normal[0] + 1.0f + hit->normal[2] * hit->normal[2]);
        for (axis = 0; axis < 3; axis++) hit->normal[axis] /= low;@STILL
    }
}

int main(void) {
    static @parameters parameters;
    static @rig rig;
    static @state state;
    static @frame frame;
    static @work work;
    static @result result;
    FILE *trace = fopen("trace.bin", "rb");
    int leg, number = 0;
    if (!trace || !fread(&parameters, sizeof parameters, 1, trace) || !fread(&rig, sizeof rig, 1, trace)) return 1;
    @init(&parameters, &rig, &state);
    for (; fread(&frame, sizeof frame, 1, trace); number++) {
@CASTING
        printf("%4d", number);
        for (leg = 0; leg < @NAME_LEGS; leg++) {
            const float *ankle = result.pose.ankle.pos[leg];
            printf("  %8.4f %8.4f %8.4f", ankle[0], ankle[1], ankle[2]);
        }
        printf("\n");
        /* the rest of a frame of the trace: its own rays, hits and result */
        fseek(trace, (long)(sizeof rays + sizeof hits + sizeof result), SEEK_CUR);
    }
    return 0;
}
