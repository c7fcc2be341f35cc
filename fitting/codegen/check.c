/* Replays a golden trace, whose numbers come from jaxik.step in Python:

       cc -O2 @file.c check.c -lm -o check && ./check trace.bin

   It ends with 0 if rays and results are as in the trace, but for rounding. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "@file.h"

static float worst = 0.0f; /* difference so far */

static void compare(const void *ours, const void *theirs, size_t size) {
    size_t i;
    for (i = 0; i < size; i += 4) {
        unsigned a, b;
        float x, y;
        memcpy(&a, (const char *)ours + i, 4), memcpy(&b, (const char *)theirs + i, 4);
        memcpy(&x, &a, 4), memcpy(&y, &b, 4);
        if (a == b) continue;
        if ((a | b) < 2 || !(fabsf(x - y) <= worst)) worst = (a | b) < 2 ? 1.0f : fabsf(x - y);
    }
}

static int read(void *data, size_t size, FILE *file) { return fread(data, size, 1, file) == 1; }

int main(int count, char **words) {
    static @parameters parameters;
    static @rig rig;
    static @state state;
    static @frame frame;
    static @work work;
    static @ray rays[@NAME_RAYS], wanted[@NAME_RAYS];
    static @hit hits[@NAME_RAYS];
    static @result result, expected;
    FILE *file = fopen(count > 1 ? words[1] : "trace.bin", "rb");
    int frames = 0;
    if (!file || !read(&parameters, sizeof parameters, file) || !read(&rig, sizeof rig, file)) return 2;
    @init(&parameters, &rig, &state);
    for (; read(&frame, sizeof frame, file); frames++) {
        if (!read(wanted, sizeof wanted, file) || !read(hits, sizeof hits, file)) return 2;
        if (!read(&expected, sizeof expected, file)) return 2;
@CALLS
        compare(rays, wanted, sizeof rays);
        compare(&result, &expected, sizeof result);
    }
    printf("%d frames, largest difference %g\n", frames, worst);
    return !frames || !(worst <= 1e-4f);
}
