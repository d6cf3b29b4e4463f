/* Principal values and axes of symmetric tensors, and what is done with axes. */
#ifndef PRINCIPAL_H
#define PRINCIPAL_H
#include <math.h>
#define DIAGONAL 1e-18  /* what may be left off the diagonal: the axes are then exact to this over the gap */
#if defined(__AVX512F__) && defined(__GNUC__) && !defined(__clang__)
#pragma GCC target("prefer-vector-width=512")
#endif

#define W 8  /* points side by side, so that the compiler takes vector instructions */
#define EACH for (int k = 0; k < W; ++k)
typedef double lanes[W];

/* One rotation of Jacobi's method in the plane of the axes p and q: apq becomes zero. */
static inline void rotate(double *app, double *aqq, double *apq, double *arp, double *arq, lanes *vp, lanes *vq)
{
    lanes c, s;
    EACH {
        const double d = aqq[k] - app[k], b = 2.0 * apq[k];
        const double t = copysign(1.0, d) * b / (fabs(d) + sqrt(d * d + b * b) + 1e-300);
        c[k] = 1.0 / sqrt(1.0 + t * t);
        s[k] = t * c[k];
        app[k] -= 0.5 * t * b;
        aqq[k] += 0.5 * t * b;
        apq[k] = 0.0;
        const double rp = arp[k], rq = arq[k];
        arp[k] = c[k] * rp - s[k] * rq;
        arq[k] = s[k] * rp + c[k] * rq;
    }
    for (int i = 0; i < 3; ++i) EACH {
        const double x = vp[i][k], y = vq[i][k];
        vp[i][k] = c[k] * x - s[k] * y;
        vq[i][k] = s[k] * x + c[k] * y;
    }
}

/* The larger of two values first, with its axis. */
static inline void order(double *a, double *b, lanes *u, lanes *v)
{
    EACH {
        const double x = a[k], y = b[k];
        a[k] = x < y ? y : x;
        b[k] = x < y ? x : y;
        for (int i = 0; i < 3; ++i) {
            const double p = u[i][k], q = v[i][k];
            u[i][k] = x < y ? q : p;
            v[i][k] = x < y ? p : q;
        }
    }
}

/* Principal values of W tensors, the largest first, and their axes; a: components 00 11 22 12 02 01, the values on
   return. By Jacobi's method; returns the most that is left off a diagonal. */
static double jacobi(lanes a[6], lanes axes[3][3])
{
    lanes *u = axes[0], *v = axes[1], *w = axes[2];
    for (int i = 0; i < 3; ++i) EACH {
        u[i][k] = i == 0;
        v[i][k] = i == 1;
        w[i][k] = i == 2;
    }
    double left = 1.0;
    for (int sweep = 0; sweep < 12 && left > DIAGONAL; ++sweep) {
        rotate(a[0], a[1], a[5], a[4], a[3], u, v);
        rotate(a[0], a[2], a[4], a[5], a[3], u, w);
        rotate(a[1], a[2], a[3], a[5], a[4], v, w);
        lanes size;
        EACH size[k] = fabs(a[5][k]) + fabs(a[4][k]);  /* the last rotation has made a[3] zero */
        left = 0.0;
        EACH left = size[k] > left ? size[k] : left;
    }
    order(a[0], a[1], u, v);
    order(a[1], a[2], v, w);
    order(a[0], a[1], u, v);
    return left;
}

static inline void normalise(const double *x, double *unit)
{
    double size = fmax(fmax(fabs(x[0]), fabs(x[1])), fabs(x[2]));
    size = size > 0.0 ? 1.0 / size : 1.0;
    const double a = x[0] * size, b = x[1] * size, c = x[2] * size;
    const double length = sqrt(a * a + b * b + c * c), scale = length > 0.0 ? 1.0 / length : 1.0;
    unit[0] = a * scale, unit[1] = b * scale, unit[2] = c * scale;
}

static inline void cross(const double *a, const double *b, double *result)
{
    result[0] = a[1] * b[2] - a[2] * b[1];
    result[1] = a[2] * b[0] - a[0] * b[2];
    result[2] = a[0] * b[1] - a[1] * b[0];
}

/* spectral.drop_noise_shear: t with the given axes, rows, for its own, where it has no more than `noise` across them. */
static inline void steady(const double *t, const double *axes, double noise, double *result)
{
    double f[3][3], across[3], tf[3][3], part[3], value[3];
    normalise(axes, f[0]);
    const double *second = axes + 3;
    const double along = second[0] * f[0][0] + second[1] * f[0][1] + second[2] * f[0][2];
    for (int i = 0; i < 3; ++i) part[i] = second[i] - along * f[0][i];
    normalise(part, f[1]);
    cross(f[0], f[1], f[2]);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            tf[i][j] = t[3 * j] * f[i][0] + t[3 * j + 1] * f[i][1] + t[3 * j + 2] * f[i][2];
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3;
        value[i] = f[i][0] * tf[i][0] + f[i][1] * tf[i][1] + f[i][2] * tf[i][2];
        across[i] = fabs(f[i][0] * tf[j][0] + f[i][1] * tf[j][1] + f[i][2] * tf[j][2]);
    }
    const int keep = across[0] <= noise && across[1] <= noise && across[2] <= noise;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            result[3 * i + j] = !keep ? t[3 * i + j]
                : value[0] * f[0][i] * f[0][j] + value[1] * f[1][i] * f[1][j] + value[2] * f[2][i] * f[2][j];
}
#endif
