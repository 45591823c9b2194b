// The u phase of Algorithm S1 (lines 9-11) in the gauge, one division a tuple: the same loop as the Numba
// kernel `_u_chunk`, for comparison. Compiled on the spot by bench_s1.py.
#include <cstdint>

extern "C" double u_chunk(const int32_t *pair, const int32_t *pair_next, const double *g, double *z,
                          double q, double lr_u, double lr_rho, double q_min, int new_u, int64_t n) {
    const double keep = 1 - lr_u, keep_rho = 1 - lr_rho, both = keep_rho * lr_u + lr_rho;
    for (int64_t t = 0; t < n; ++t) {
        const int32_t k = pair[t], j = pair_next[t];
        const double gain = g[k], w = gain * z[j], kept = keep * z[k], z_new = kept + (lr_u * w) * q;
        z[k] = z_new;
        const bool same = new_u && k == j;
        const double den_kept = same ? keep_rho : keep_rho * kept;
        const double den_w = same ? lr_rho * gain : both * w;
        const double num = same ? 1.0 : z_new;
        q *= num / (den_kept + den_w * q);
        q = q < q_min ? q_min : q;
    }
    return q;
}

// Lines 10-11 as they stand, two divisions, the listing's order.
extern "C" double listing(const int32_t *pair, const int32_t *pair_next, const double *g, double *z,
                          double rho, double lr_u, double lr_rho, double rho_max, int new_u, int64_t n) {
    for (int64_t t = 0; t < n; ++t) {
        const int32_t k = pair[t], j = pair_next[t];
        double next = z[j];
        z[k] = (1 - lr_u) * z[k] + lr_u * g[k] / rho * next;
        if (new_u) next = z[j];
        rho = (1 - lr_rho) * rho + lr_rho * g[k] * next / z[k];
        rho = rho > rho_max ? rho_max : rho;
    }
    return rho;
}
