// Updates of asql (separate = 0) and deep_s1 (1), hand-written: what erl_torch/networks/kernels.py is held against.
// g++ -O3 -march=native -ffast-math -shared -fPIC; arguments as of kernels.advance, squared loss, restart.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

using Vec = std::vector<float>;

static uint64_t next(uint64_t &s) {
    uint64_t z = (s += 0x9E3779B97F4A7C15ull);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
    return z ^ (z >> 31);
}

// c [n, m] = a [n, k] b [k, m], four rows at a time
static void product(const float *__restrict a, const float *__restrict b, float *__restrict c, int n, int k, int m) {
    int i = 0;
    for (; i + 4 <= n; i += 4) {
        float *c0 = c + i * m, *c1 = c0 + m, *c2 = c1 + m, *c3 = c2 + m;
        std::memset(c0, 0, 4 * m * sizeof(float));
        for (int p = 0; p < k; p++) {
            float x0 = a[i * k + p], x1 = a[(i + 1) * k + p], x2 = a[(i + 2) * k + p], x3 = a[(i + 3) * k + p];
            const float *row = b + p * m;
            for (int j = 0; j < m; j++) {
                c0[j] += x0 * row[j];
                c1[j] += x1 * row[j];
                c2[j] += x2 * row[j];
                c3[j] += x3 * row[j];
            }
        }
    }
    for (; i < n; i++) {
        float *c0 = c + i * m;
        std::memset(c0, 0, m * sizeof(float));
        for (int p = 0; p < k; p++)
            for (int j = 0; j < m; j++) c0[j] += a[i * k + p] * b[p * m + j];
    }
}

static void transposed(const float *a, float *t, int n, int m) {  // t [m, n] of a [n, m]
    for (int i = 0; i < n; i++)
        for (int j = 0; j < m; j++) t[j * n + i] = a[i * m + j];
}

struct Net {
    int d, h1, h2, o, b;
    Vec a1, a2, out, d1, d2, t;
    Net(int d, int h1, int h2, int o, int b)
        : d(d), h1(h1), h2(h2), o(o), b(b), a1(b * h1), a2(b * h2), out(b * o), d1(b * h1), d2(b * h2),
          t(b * h1 + b * h2 + b * d + h1 * h2 + h2 * o) {}
    int size() const { return (d + 1) * h1 + (h1 + 1) * h2 + (h2 + 1) * o; }
    void layer(const float *x, const float *w, int n, int m, float *y, bool relu) {
        product(x, w, y, b, n, m);
        const float *bias = w + n * m;
        for (int i = 0; i < b; i++)
            for (int j = 0; j < m; j++) {
                float v = y[i * m + j] + bias[j];
                y[i * m + j] = relu && v < 0 ? 0 : v;
            }
    }
    void forward(const float *p, const float *x) {
        layer(x, p, d, h1, a1.data(), true);
        layer(a1.data(), p + (d + 1) * h1, h1, h2, a2.data(), true);
        layer(a2.data(), p + (d + 1) * h1 + (h1 + 1) * h2, h2, o, out.data(), false);
    }
    void grad(const float *x, const float *e, int n, int m, float *s) {  // s: W [n, m], b [m] of x [b, n], e [b, m]
        transposed(x, t.data(), b, n);
        product(t.data(), e, s, n, b, m);
        float *sb = s + n * m;
        std::memset(sb, 0, m * sizeof(float));
        for (int i = 0; i < b; i++)
            for (int j = 0; j < m; j++) sb[j] += e[i * m + j];
    }
    void back(const float *e, const float *w, int n, int m, const float *y, float *into) {  // into [b, n] = e W^T, masked
        transposed(w, t.data(), n, m);
        product(e, t.data(), into, b, m, n);
        for (int i = 0; i < b * n; i++)
            if (y[i] <= 0) into[i] = 0;
    }
    void backward(const float *p, const float *x, const float *e, float *s) {
        int w2 = (d + 1) * h1, w3 = w2 + (h1 + 1) * h2;
        grad(a2.data(), e, h2, o, s + w3);
        back(e, p + w3, h2, o, a2.data(), d2.data());
        grad(a1.data(), d2.data(), h1, h2, s + w2);
        back(d2.data(), p + w2, h1, h2, a1.data(), d1.data());
        grad(x, d1.data(), d, h1, s);
    }
};

extern "C" void advance(float *w, float *lag, float *m, float *v, double *numbers, uint64_t *random, const float *obs,
                        const int32_t *act, const float *rew, const float *fol, int d, int n_act, int n, int n_updates,
                        int h1, int h2, int b, int separate, float beta, float lr, float tau, float g_rate) {
    Net q(d, h1, h2, n_act, b), l(d, h1, h2, separate ? 1 : n_act, b), value(d, h1, h2, 1, b);
    Vec x(b * d), x2(b * d), e(b * n_act), ev(b), soft(b), after(b), slope(q.size() + (separate ? value.size() : 0));
    std::vector<int> at(b);
    auto lse = [&](const float *row) {
        float top = row[0], sum = 0;
        for (int j = 1; j < n_act; j++) top = row[j] > top ? row[j] : top;
        for (int j = 0; j < n_act; j++) sum += std::exp(beta * (row[j] - top));
        return top + (std::log(sum) - std::log((float)n_act)) / beta;
    };
    for (int u = 0; u < n_updates; u++) {
        for (int i = 0; i < b; i++) {
            at[i] = (int)((next(*random) >> 11) * (1.0 / 9007199254740992.0) * n);
            std::memcpy(&x[i * d], obs + at[i] * d, d * sizeof(float));
            std::memcpy(&x2[i * d], fol + at[i] * d, d * sizeof(float));
        }
        q.forward(w, x.data());
        l.forward(lag, x2.data());
        float mean_soft = 0, mean_after = 0;
        for (int i = 0; i < b; i++) {
            soft[i] = lse(&q.out[i * n_act]);
            after[i] = separate ? l.out[i] : lse(&l.out[i * n_act]);
            mean_soft += soft[i] / b;
            mean_after += after[i] / b;
        }
        if (separate) {
            value.forward(w + q.size(), x.data());
            numbers[0] += g_rate * (mean_soft - numbers[0]);
        }
        float g = numbers[0];
        std::memset(e.data(), 0, e.size() * sizeof(float));
        for (int i = 0; i < b; i++) {
            int k = act[at[i]];
            e[i * n_act + k] = -(rew[at[i]] + after[i] - (separate ? 0 : g) - q.out[i * n_act + k]) / b;
            if (separate) ev[i] = (value.out[i] - (soft[i] - g)) / b;
        }
        if (!separate) numbers[0] += g_rate * (mean_after - numbers[0]);
        q.backward(w, x.data(), e.data(), slope.data());
        if (separate) value.backward(w + q.size(), x.data(), ev.data(), slope.data() + q.size());
        double t = ++numbers[1];
        float rate = lr / (1 - std::pow(0.9, t)), c = 1 / std::sqrt(1 - std::pow(0.999, t));
        for (size_t i = 0; i < slope.size(); i++) {
            m[i] += 0.1f * (slope[i] - m[i]);
            v[i] += 0.001f * (slope[i] * slope[i] - v[i]);
            w[i] -= rate * m[i] / (std::sqrt(v[i]) * c + 1e-8f);
        }
        int first = separate ? q.size() : 0, size = separate ? value.size() : q.size();
        for (int i = 0; i < size; i++) lag[i] += tau * (w[first + i] - lag[i]);
    }
}
