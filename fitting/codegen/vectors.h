/* Vectors of LANES numbers, and functions of them as XLA defines these; for GCC and Clang. */

#include <math.h>
#include <stddef.h>
#include <string.h>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

typedef float vf __attribute__((vector_size(4 * LANES)));
typedef int vi __attribute__((vector_size(4 * LANES)));
typedef unsigned vu __attribute__((vector_size(4 * LANES)));

#define INLINE static inline __attribute__((always_inline))
#define APART static __attribute__((noinline))
#define EACH for (int i = 0; i < LANES; i++)

INLINE vf all(float x) {
    vf y;
    EACH y[i] = x;
    return y;
}

INLINE vi all_int(int x) {
    vi y;
    EACH y[i] = x;
    return y;
}

INLINE vu all_unsigned(unsigned x) { return (vu)all_int((int)x); }

#if LANES == 16 && defined(__AVX512F__) /* a bit for each lane */
typedef __mmask16 vb;
#define AND(a, b) ((vb)((a) & (b)))
#define OR(a, b) ((vb)((a) | (b)))
#define XOR(a, b) ((vb)((a) ^ (b)))
#define NOT(a) ((vb)~(a))
#define COMPARE(name, float_sign, int_sign, sign) \
    INLINE vb name##_float(vf a, vf b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, float_sign); } \
    INLINE vb name##_int(vi a, vi b) { return _mm512_cmp_epi32_mask((__m512i)a, (__m512i)b, int_sign); } \
    INLINE vb name##_unsigned(vu a, vu b) { return _mm512_cmp_epu32_mask((__m512i)a, (__m512i)b, int_sign); }
INLINE vb all_bool(int x) { return x ? 0xffff : 0; }
INLINE vb select_bool(vb chosen, vb yes, vb no) { return OR(AND(chosen, yes), AND(NOT(chosen), no)); }
INLINE vf select_float(vb chosen, vf yes, vf no) {
    return (vf)_mm512_mask_blend_ps(chosen, (__m512)no, (__m512)yes);
}
INLINE vi select_int(vb chosen, vi yes, vi no) {
    return (vi)_mm512_mask_blend_epi32(chosen, (__m512i)no, (__m512i)yes);
}
INLINE int any(vb chosen) { return chosen != 0; }
#else /* -1 or 0 in each lane */
typedef vi vb;
#define AND(a, b) ((a) & (b))
#define OR(a, b) ((a) | (b))
#define XOR(a, b) ((a) ^ (b))
#define NOT(a) (~(a))
#define COMPARE(name, float_sign, int_sign, sign) \
    INLINE vb name##_float(vf a, vf b) { return a sign b; } \
    INLINE vb name##_int(vi a, vi b) { return a sign b; } \
    INLINE vb name##_unsigned(vu a, vu b) { return a sign b; }
INLINE vb all_bool(int x) { return all_int(-x); }
INLINE vi select_int(vb chosen, vi yes, vi no) { return (chosen & yes) | (~chosen & no); }
INLINE vb select_bool(vb chosen, vb yes, vb no) { return select_int(chosen, yes, no); }
INLINE vf select_float(vb chosen, vf yes, vf no) {
#if LANES == 8 && defined(__AVX__)
    return (vf)_mm256_blendv_ps((__m256)no, (__m256)yes, (__m256)chosen);
#else
    return (vf)select_int(chosen, (vi)yes, (vi)no);
#endif
}
INLINE int any(vb chosen) {
    int result = 0;
    EACH result |= chosen[i];
    return result;
}
#endif

INLINE vu select_unsigned(vb chosen, vu yes, vu no) {
    return (vu)select_int(chosen, (vi)yes, (vi)no);
}

COMPARE(LT, _CMP_LT_OQ, _MM_CMPINT_LT, <)
COMPARE(LE, _CMP_LE_OQ, _MM_CMPINT_LE, <=)
COMPARE(EQ, _CMP_EQ_OQ, _MM_CMPINT_EQ, ==)
COMPARE(NE, _CMP_NEQ_UQ, _MM_CMPINT_NE, !=)

INLINE vi maximum_int(vi a, vi b) { return select_int(LT_int(a, b), b, a); }
INLINE vi minimum_int(vi a, vi b) { return select_int(LT_int(a, b), a, b); }
INLINE vu maximum_unsigned(vu a, vu b) { return select_unsigned(LT_unsigned(a, b), b, a); }
INLINE vu minimum_unsigned(vu a, vu b) { return select_unsigned(LT_unsigned(a, b), a, b); }

INLINE vf vabs(vf x) { return (vf)((vi)x & 0x7fffffff); }

INLINE vf with_sign(vf x, vf sign) { return (vf)(((vi)x & 0x7fffffff) | ((vi)sign & (-0x7fffffff - 1))); }

INLINE vf vsqrt(vf x) {
#if LANES == 16 && defined(__AVX512F__)
    return (vf)_mm512_sqrt_ps((__m512)x);
#elif LANES == 8 && defined(__AVX__)
    return (vf)_mm256_sqrt_ps((__m256)x);
#elif LANES == 4 && defined(__SSE2__)
    return (vf)_mm_sqrt_ps((__m128)x);
#else
    EACH x[i] = sqrtf(x[i]);
    return x;
#endif
}

INLINE vf lesser(vf a, vf b) {
#if LANES == 16 && defined(__AVX512F__)
    return (vf)_mm512_min_ps((__m512)a, (__m512)b);
#elif LANES == 8 && defined(__AVX__)
    return (vf)_mm256_min_ps((__m256)a, (__m256)b);
#elif LANES == 4 && defined(__SSE2__)
    return (vf)_mm_min_ps((__m128)a, (__m128)b);
#else
    return select_float(LT_float(a, b), a, b);
#endif
}

INLINE vf greater(vf a, vf b) {
#if LANES == 16 && defined(__AVX512F__)
    return (vf)_mm512_max_ps((__m512)a, (__m512)b);
#elif LANES == 8 && defined(__AVX__)
    return (vf)_mm256_max_ps((__m256)a, (__m256)b);
#elif LANES == 4 && defined(__SSE2__)
    return (vf)_mm_max_ps((__m128)a, (__m128)b);
#else
    return select_float(LT_float(b, a), a, b);
#endif
}

INLINE vf maximum_float(vf a, vf b) { return select_float(NE_float(a, a), a, greater(a, b)); }

INLINE vf minimum_float(vf a, vf b) { return select_float(NE_float(a, a), a, lesser(a, b)); }

INLINE vf sign_of(vf x) {
    const vf zero = all(0.0f), size = select_float(NE_float(x, zero), all(1.0f), zero);
    return select_float(EQ_float(x, x), with_sign(size, x), x);
}

INLINE vf vround(vf x) { /* to the nearest even */
#if LANES == 16 && defined(__AVX512F__)
    return (vf)_mm512_roundscale_ps((__m512)x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
#elif LANES == 8 && defined(__AVX__)
    return (vf)_mm256_round_ps((__m256)x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
#else
    const vf large = all(8388608.0f); /* from here on every number is whole */
    const vf whole = with_sign((vabs(x) + large) - large, x);
    return select_float(LT_float(vabs(x), large), whole, x);
#endif
}

INLINE vf vfloor(vf x) {
    const vf whole = vround(x);
    return select_float(LT_float(x, whole), whole - 1.0f, whole);
}

INLINE vf vceil(vf x) {
    const vf whole = vround(x);
    return select_float(LT_float(whole, x), with_sign(whole + 1.0f, x), whole);
}

INLINE vi int_of(vf x) {
    const vf limit = all(2147483648.0f);
    const vf usual = select_float(LT_float(vabs(x), limit), x, all(0.0f));
    const vi most = select_int(LE_float(limit, x), all_int(2147483647), __builtin_convertvector(usual, vi));
    return select_int(LE_float(x, -limit), all_int(-2147483647 - 1), most);
}

INLINE vu unsigned_of(vf x) {
    vu y;
    EACH y[i] = !(x[i] > 0) ? 0u : x[i] >= 4294967296.0f ? 4294967295u : (unsigned)x[i];
    return y;
}

/* x times 2 to the power of a whole number from -252 to 254. */
INLINE vf scaled(vf x, vf n) {
#if LANES == 16 && defined(__AVX512F__)
    return (vf)_mm512_scalef_ps((__m512)x, (__m512)n);
#else
    const vi half = __builtin_convertvector(n, vi) >> 1, rest = __builtin_convertvector(n, vi) - half;
    return x * (vf)((half + 127) << 23) * (vf)((rest + 127) << 23);
#endif
}

#define LOG2_HIGH 0.693359375f
#define LOG2_LOW -2.12194440e-4f
#define LOWEST all(-104.0f) /* exp is 0 */
#define HIGHEST all(89.0f) /* exp is infinite */

/* x = n log(2) + r, with r from -log(2) / 2 to log(2) / 2, and expm1(r) by Cephes's polynomial. */
INLINE vf reduced(vf x, vf *n) {
    const vf y = greater(LOWEST, lesser(HIGHEST, x)); /* NaN stays */
    *n = vround(y * 1.44269504f);
    const vf r = (y - *n * LOG2_HIGH) - *n * LOG2_LOW;
    vf p = r * 1.9875691500e-4f + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    return p * r * r + r;
}

APART vf vexp(vf x) {
    vf n;
    const vf small = reduced(x, &n);
    return scaled(small + 1.0f, n);
}

APART vf vexpm1(vf x) {
    vf n;
    const vf small = reduced(x, &n), power = scaled(all(1.0f), n);
    const vf result = scaled(small, n) + (power - 1.0f);
    return select_float(LT_float(all(126.0f), n), scaled(small + 1.0f, n), result);
}

/* By Cephes's polynomial. */
APART vf vlog(vf x) {
    const vi bits = (vi)x;
    const vf part = (vf)((bits & 0x007fffff) | 0x3f000000); /* from 0.5 to 1 */
    const vb low = LT_float(part, all(0.707106781f));
    const vf e = __builtin_convertvector((bits >> 23) - select_int(low, all_int(127), all_int(126)), vf);
    const vf m = select_float(low, part + part, part) - 1.0f, z = m * m;
    vf p = m * 7.0376836292e-2f - 1.1514610310e-1f;
    p = p * m + 1.1676998740e-1f;
    p = p * m - 1.2420140846e-1f;
    p = p * m + 1.4249322787e-1f;
    p = p * m - 1.6668057665e-1f;
    p = p * m + 2.0000714765e-1f;
    p = p * m - 2.4999993993e-1f;
    p = p * m + 3.3333331174e-1f;
    vf result = m + (p * m * z + e * LOG2_LOW - 0.5f * z) + e * LOG2_HIGH;
    result = select_float(EQ_float(x, all(INFINITY)), x, result);
    result = select_float(LT_float(x, all(1.17549435e-38f)), all(-INFINITY), result);
    return select_float(LE_float(all(0.0f), x), result, all(NAN));
}

APART vf vlog1p(vf x) {
    const vf u = x + 1.0f, result = vlog(u) * (x / (u - 1.0f));
    const vb same = OR(EQ_float(u, all(1.0f)), EQ_float(x, all(INFINITY)));
    return select_float(same, x, select_float(EQ_float(u, all(0.0f)), all(-INFINITY), result));
}

/* Sine or, one quarter further, cosine, by Cephes's polynomials. */
APART vf sine_of(vf x, int quarters) {
    const vf n = vround(x * 0.636619772f);
    const vf r = ((x - n * 1.5703125f) - n * 4.837512969970703125e-4f) - n * 7.549789954891e-8f;
    const vi turn = int_of(n) + quarters;
    const vf z = r * r;
    vf s = z * -1.9515295891e-4f + 8.3321608736e-3f;
    s = (s * z - 1.6666654611e-1f) * z * r + r;
    vf c = z * 2.443315711809948e-5f - 1.388731625493765e-3f;
    c = (c * z + 4.166664568298827e-2f) * z * z - 0.5f * z + 1.0f;
    vf result = select_float(NE_int(turn & 1, all_int(0)), c, s);
    result = (vf)((vi)result ^ ((turn & 2) << 30));
    if (any(NOT(LT_float(vabs(x), all(8000.0f)))))
        EACH if (!(fabsf(x[i]) < 8000.0f)) result[i] = quarters ? cosf(x[i]) : sinf(x[i]);
    return result;
}

INLINE vf vsin(vf x) { return sine_of(x, 0); }

INLINE vf vcos(vf x) { return sine_of(x, 1); }

#define BY_LANE(name, function) \
    APART vf name(vf x) { EACH x[i] = function(x[i]); return x; }
#define BY_LANE_OF_TWO(name, function) \
    APART vf name(vf x, vf y) { EACH x[i] = function(x[i], y[i]); return x; }
BY_LANE(vcbrt, cbrtf)
BY_LANE(vtan, tanf)
BY_LANE(vtanh, tanhf)
BY_LANE_OF_TWO(vfmod, fmodf)
BY_LANE_OF_TWO(vpow, powf)
BY_LANE_OF_TWO(vatan2, atan2f)

/* Numbers of a table at indices within it. */
INLINE vf read_float(vi index, const float *table) {
#if LANES == 16 && defined(__AVX512F__)
    return (vf)_mm512_i32gather_ps((__m512i)index, table, 4);
#else
    vf x;
    EACH x[i] = table[index[i]];
    return x;
#endif
}

INLINE vi read_int(vi index, const int *table) {
    return (vi)read_float(index, (const float *)table);
}

INLINE vu read_unsigned(vi index, const unsigned *table) {
    return (vu)read_float(index, (const float *)table);
}

/* Has the processor take denormal numbers for 0, as XLA does; returns what it did before. */
INLINE unsigned flush_denormals(void) {
#if defined(__SSE2__)
    const unsigned before = _mm_getcsr();
    _mm_setcsr(before | 0x8040);
    return before;
#else
    return 0;
#endif
}

INLINE void restore_denormals(unsigned before) {
#if defined(__SSE2__)
    _mm_setcsr(before);
#else
    (void)before;
#endif
}

/* Where a number of the first character and frame is, and how many bytes further those of others. */
typedef struct place {
    char *at;
    ptrdiff_t member, frame;
} place;

/* How a number lies in memory for the characters of a block. */
typedef enum layout { SHARED, ADJACENT, SCATTERED } layout;

INLINE layout layout_of(const place *place, int whole, int shifted) {
    if (place->member == 0 && !(shifted && place->frame)) return SHARED;
    return place->member == 4 && whole && !(shifted && place->frame) ? ADJACENT : SCATTERED;
}

/* Numbers of the characters of a block, each with the frame that it starts with. */
INLINE vf load(const char *from, layout layout, const place *place, vi lane, vi start) {
    vf x;
    if (layout == SHARED) {
        float y;
        memcpy(&y, from, 4);
        return all(y);
    }
    if (layout == ADJACENT) {
        memcpy(&x, from, sizeof x);
        return x;
    }
    const vi offsets = lane * (int)place->member + start * (int)place->frame;
#if LANES == 16 && defined(__AVX512F__)
    return (vf)_mm512_i32gather_ps((__m512i)offsets, from, 1);
#else
    EACH {
        float y;
        memcpy(&y, from + offsets[i], 4);
        x[i] = y;
    }
    return x;
#endif
}

INLINE void store(char *to, layout layout, ptrdiff_t member, ptrdiff_t count, vf x) {
#if LANES == 16 && defined(__AVX512F__)
    if (layout == ADJACENT && (size_t)to % sizeof x == 0) { /* whole lines past the cache */
        _mm512_stream_ps((float *)to, (__m512)x);
        return;
    }
#endif
    if (layout == ADJACENT) {
        memcpy(to, &x, sizeof x);
        return;
    }
    for (ptrdiff_t i = 0; i < count; i++) {
        const float y = x[i];
        memcpy(to + i * member, &y, 4);
    }
}
