// Lines 9-11 of Algorithm S1 (gauge, one division a tuple) for many lanes at once, in AVX2 by hand: what the kernels
// `lanes_epoch` and `shared_epoch` are measured against. Compiled on the spot by bench_replicas.py.
// Tables hold the lanes of a pair side by side; lanes is a multiple of 4.
#include <immintrin.h>

#include <cstdint>

namespace {

struct Rates {
    const double *lr_u, *lr_rho, *q_min;
};

inline __m256d update(__m256d gain, __m256d z, __m256d z_next, double *q, const Rates &rates, int64_t i) {
    const __m256d one = _mm256_set1_pd(1.0);
    const __m256d lr_u = _mm256_loadu_pd(rates.lr_u + i), lr_rho = _mm256_loadu_pd(rates.lr_rho + i);
    const __m256d keep = _mm256_sub_pd(one, lr_u), keep_rho = _mm256_sub_pd(one, lr_rho);
    const __m256d both = _mm256_fmadd_pd(keep_rho, lr_u, lr_rho);
    const __m256d root = _mm256_loadu_pd(q + i);
    const __m256d w = _mm256_mul_pd(gain, z_next), kept = _mm256_mul_pd(keep, z);
    const __m256d z_new = _mm256_fmadd_pd(_mm256_mul_pd(lr_u, w), root, kept);
    const __m256d below = _mm256_fmadd_pd(_mm256_mul_pd(both, w), root, _mm256_mul_pd(keep_rho, kept));
    const __m256d root_new = _mm256_mul_pd(root, _mm256_div_pd(z_new, below));
    _mm256_storeu_pd(q + i, _mm256_max_pd(root_new, _mm256_loadu_pd(rates.q_min + i)));
    return z_new;
}

}  // namespace

extern "C" void own_streams(const int32_t *pair, const int32_t *pair_next, const double *g, double *z, double *q,
                            const double *lr_u, const double *lr_rho, const double *q_min, int64_t lanes, int64_t n) {
    const Rates rates{lr_u, lr_rho, q_min};
    const __m128i size = _mm_set1_epi32(int32_t(lanes)), four = _mm_setr_epi32(0, 1, 2, 3);
    for (int64_t t = 0; t < n; ++t)
        for (int64_t i = 0; i < lanes; i += 4) {
            const __m128i lane = _mm_add_epi32(_mm_set1_epi32(int32_t(i)), four);
            const auto at = [&](const int32_t *column) {
                const __m128i k = _mm_loadu_si128(reinterpret_cast<const __m128i *>(column + t * lanes + i));
                return _mm_add_epi32(_mm_mullo_epi32(k, size), lane);
            };
            const __m128i k = at(pair), j = at(pair_next);
            const __m256d z_new = update(_mm256_i32gather_pd(g, k, 8), _mm256_i32gather_pd(z, k, 8),
                                         _mm256_i32gather_pd(z, j, 8), q, rates, i);
            alignas(32) double out[4];
            alignas(16) int32_t where[4];
            _mm256_store_pd(out, z_new);
            _mm_store_si128(reinterpret_cast<__m128i *>(where), k);
            for (int m = 0; m < 4; ++m) z[where[m]] = out[m];
        }
}

extern "C" void shared_stream(const int32_t *pair, const int32_t *pair_next, const double *g, double *z, double *q,
                              const double *lr_u, const double *lr_rho, const double *q_min, int64_t lanes,
                              int64_t n) {
    const Rates rates{lr_u, lr_rho, q_min};
    for (int64_t t = 0; t < n; ++t) {
        const int64_t k = pair[t] * lanes, j = pair_next[t] * lanes;
        for (int64_t i = 0; i < lanes; i += 4)
            _mm256_storeu_pd(z + k + i, update(_mm256_loadu_pd(g + k + i), _mm256_loadu_pd(z + k + i),
                                               _mm256_loadu_pd(z + j + i), q, rates, i));
    }
}
