/* Blocks of 32 side by side; grids whose sides halve to 1 x 1 or to `rest` samples, which stay. */
#include <math.h>
typedef float * restrict V;
typedef const float * restrict C;
typedef const unsigned * restrict I;

static void hadamard(float *v, long n) {
    long run = n / 32;
    for (; 4 * run <= n; run *= 4)
        for (long base = 0; base < n; base += 4 * run) {
            V a = v + base, b = a + run, c = b + run, d = c + run;
            for (long k = 0; k < run; k++) {
                float s = a[k] + b[k], t = c[k] + d[k], u = a[k] - b[k], w = c[k] - d[k];
                a[k] = s + t; b[k] = u + w; c[k] = s - t; d[k] = u - w;
            }
        }
    V a = v, b = v + n / 2;
    for (long k = 0; k < n / 2; k++) { float s = a[k] + b[k]; b[k] = a[k] - b[k]; a[k] = s; }
}

static void halve(float *v, long part, long levels) {
    for (; levels > 0; levels--, part /= 4) {
        long q = part / 4;
        V a = v, b = v + q, c = v + 2 * q, d = v + 3 * q;
        for (long k = 0; k < q; k++) {
            float s = a[k] + c[k], t = b[k] + d[k], u = a[k] - c[k], w = b[k] - d[k];
            a[k] = s + t; b[k] = s - t; c[k] = u + w; d[k] = u - w;
        }
    }
}

static void twice(float *v, long n, long levels) {
    for (long level = levels - 1; level >= 0; level--) {
        long q = (n >> (2 * level)) / 4;
        V a = v, b = v + q, c = v + 2 * q, d = v + 3 * q;
        for (long k = 0; k < q; k++) {
            float s = a[k] + b[k], t = a[k] - b[k], u = c[k] + d[k], w = c[k] - d[k];
            a[k] = s + u; b[k] = t + w; c[k] = s - u; d[k] = t - w;
        }
    }
}

void fista(V theta, V before, float beta, C weights2, C threshold, V z, V v, I deal, C keep,
           C measured, long n, long levels) {
    for (long k = 0; k < n; k++) z[k] = theta[k] + beta * (theta[k] - before[k]);
    twice(z, n, levels);
    for (long p = 0; p < n; p++) v[p] = z[deal[p]];
    hadamard(v, n);
    for (long p = 0; p < n; p++) v[p] = v[p] * keep[p] + measured[p];
    hadamard(v, n);
    for (long p = 0; p < n; p++) z[deal[p]] = v[p];
    halve(z, n, levels);
    for (long k = 0; k < n; k++) {
        float u = weights2[k] * z[k], t = threshold[k];
        before[k] = u - fminf(fmaxf(u, -t), t);
    }
}

void skin(V x, V z, V r, C target, V total, I to_canvas, I from_canvas, V canvas, V u, C measured,
          float threshold, float least, long n) {
    for (long p = 0; p < n; p++) u[p] = z[p];
    hadamard(u, n);
    float power = 0;
    for (long p = 0; p < n; p++) {
        r[p] = target[p] - measured[p] * u[p];
        u[p] = measured[p] * r[p];
        power += r[p] * r[p];
    }
    hadamard(u, n);
    for (long p = 0; p < n; p++) u[p] += z[p];
    float limit = fmaxf(threshold * sqrtf(power), least), l2 = limit * limit + 1e-30f, w2 = 1;
    for (long k = 0; k < n; k++) canvas[k] = u[to_canvas[k]];
    halve(canvas, n, 3);
    for (long level = 1, part = n; level <= 3; level++, part /= 4) {
        w2 /= 4;
        for (long k = level < 3 ? part / 4 : 0; k < part; k++) {
            float c = canvas[k];
            canvas[k] = c * (w2 - l2 / fmaxf(c * c, l2 / w2));
        }
    }
    twice(canvas, n, 3);
    for (long p = 0; p < n; p++) {
        float after = fmaxf(canvas[from_canvas[p]], 0);
        z[p] = after + 0.7f * (after - x[p]);
        x[p] = after;
        total[p] += after;
    }
}
