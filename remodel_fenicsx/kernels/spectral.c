/* What a pass and its limits compute at every point. Plain arrays in, plain arrays out; the Python functions that these
   stand for are listed in kernels/__init__.py and named below. Where a tensor does not decide (values that agree, signs
   that are weak) nothing is decided here: the point is marked, and spectral.py does it. */
#include <math.h>
#include <stdint.h>
#include "principal.h"

static inline double largest_of(const double *x, int count)
{
    double largest = 0.0, sum = 0.0;
    for (int i = 0; i < count; ++i) {
        largest = fabs(x[i]) > largest ? fabs(x[i]) : largest;
        sum += fabs(x[i]);
    }
    return sum - sum == 0.0 || largest > 1e300 ? largest : NAN;  /* NaN and infinity do not get lost in comparisons */
}

/* Cosines of unit vectors with others of any length: these are divided by their largest component first. */
static inline void cosine_of(lanes *unit, lanes *other, double *cosine)
{
    EACH {
        const double x = fabs(other[0][k]), y = fabs(other[1][k]), z = fabs(other[2][k]);
        const double xy = x > y ? x : y, size = (xy > z ? xy : z) + 1e-300;
        const double a = other[0][k] / size, b = other[1][k] / size, c = other[2][k] / size;
        cosine[k] = (unit[0][k] * a + unit[1][k] * b + unit[2][k] * c) / (sqrt(a * a + b * b + c * c) + 1e-300);
    }
}

/* spectral.principal. open: 1 where it is left open, 2 where a number is not finite; returns how many there are. */
int64_t principal(int64_t n, const double *tensors, const double *previous, double tolerance, const double *threshold,
                  double decisive, double *values, double *axes, uint8_t *open)
{
    int64_t count = 0;
    for (int64_t first = 0; first < n; first += W) {
        lanes a[6], frame[3][3], scale;
        uint8_t bad[W];
        for (int k = 0; k < W; ++k) {
            const int64_t at = first + k < n ? first + k : n - 1;
            const double *t = tensors + 9 * at;
            const double m[6] = {t[0], t[4], t[8], 0.5 * t[5] + 0.5 * t[7], 0.5 * t[2] + 0.5 * t[6],
                                 0.5 * t[1] + 0.5 * t[3]};
            const double size = largest_of(m, 6);
            bad[k] = !isfinite(size) || !isfinite(largest_of(previous + 9 * at, 9)) ? 2
                   : size > 1e-290 && size < 1e290 ? 0 : 1;
            const double inverse = bad[k] ? 0.0 : 1.0 / size;
            scale[k] = size;
            for (int i = 0; i < 6; ++i) a[i][k] = bad[k] ? (i < 3 ? 3.0 - i : 0.0) : m[i] * inverse;
        }
        const double left = jacobi(a, frame);
        lanes cosine[3], weakest, gap;
        for (int rank = 0; rank < 3; ++rank) {
            lanes p[3];
            for (int i = 0; i < 3; ++i)
                for (int k = 0; k < W; ++k)
                    p[i][k] = previous[9 * (first + k < n ? first + k : n - 1) + 3 * rank + i];
            cosine_of(frame[rank], p, cosine[rank]);
        }
        EACH {
            const double x = fabs(cosine[0][k]), y = fabs(cosine[1][k]), z = fabs(cosine[2][k]);
            const double xy = x < y ? x : y, upper = a[0][k] - a[1][k], lower = a[1][k] - a[2][k];
            weakest[k] = xy < z ? xy : z;
            gap[k] = upper < lower ? upper : lower;
        }
        for (int k = 0; k < W && first + k < n; ++k) {
            const int64_t at = first + k;
            const double size = scale[k], largest = fmax(fabs(a[0][k]), fabs(a[2][k]));
            const double relative = tolerance * largest * size, equal = threshold[at];
            /* what is within 1 % of a limit is left to the code that knows the limit */
            if (!bad[k] && !(size * gap[k] > 1.01 * (relative > equal ? relative : equal)
                             && weakest[k] > 1.01 * decisive && left <= DIAGONAL)) bad[k] = 1;
            for (int rank = 0; rank < 3; ++rank) {
                const double sign = cosine[rank][k] < 0.0 ? -1.0 : 1.0;
                for (int i = 0; i < 3; ++i) axes[9 * at + 3 * rank + i] = sign * frame[rank][i][k];
            }
            for (int i = 0; i < 3; ++i) values[3 * at + i] = size * a[i][k];
            open[at] = bad[k];
            count += bad[k] != 0;
        }
    }
    return count;
}

/* spectral.positive_direction; returns how many points have a number that is not finite. */
int64_t positive_direction(int64_t n, const double *values, const double *threshold, double rounding,
                           double *direction, uint8_t *active)
{
    int64_t count = 0;
    for (int64_t at = 0; at < n; ++at) {
        const double *v = values + 3 * at;
        const double a = fabs(v[0]), b = fabs(v[1]), c = fabs(v[2]), ab = a > b ? a : b, largest = ab > c ? ab : c;
        const double least = rounding * largest > threshold[at] ? rounding * largest : threshold[at];
        const double inverse = largest > 0.0 ? 1.0 / largest : 1.0;
        const double x = v[0] > least ? v[0] * inverse : 0.0, y = v[1] > least ? v[1] * inverse : 0.0;
        const double z = v[2] > least ? v[2] * inverse : 0.0, length = sqrt(x * x + y * y + z * z);
        const double scale = length > 0.0 ? 1.0 / length : 0.0;
        direction[3 * at] = x * scale, direction[3 * at + 1] = y * scale, direction[3 * at + 2] = z * scale;
        active[at] = length > 0.0;
        count += !(a + b + c - (a + b + c) == 0.0);
    }
    return count;
}

/* spectral.drop_noise_shear. */
void drop_noise_shear(int64_t n, const double *tensors, const double *axes, const double *noise, double *result)
{
    for (int64_t at = 0; at < n; ++at) steady(tensors + 9 * at, axes + 9 * at, noise[at], result + 9 * at);
}

/* energy.squared_end_to_end_length: r^2 = sum l_I^2 I_I. */
void squared_length(int64_t n, const double *F, const double *dimensions, const double *axes, double *squared)
{
    for (int64_t at = 0; at < n; ++at) {
        const double *f = F + 9 * at;
        double length = 0.0;
        for (int rank = 0; rank < 3; ++rank) {
            const double *a = axes + 9 * at + 3 * rank, l = dimensions[3 * at + rank];
            const double x = f[0] * a[0] + f[1] * a[1] + f[2] * a[2], y = f[3] * a[0] + f[4] * a[1] + f[5] * a[2];
            const double z = f[6] * a[0] + f[7] * a[1] + f[8] * a[2];
            length += l * l * (x * x + y * y + z * z);
        }
        squared[at] = length;
    }
}

/* cells.structure_tensor: A = sum l_I^2 n_I (x) n_I. */
void structure(int64_t n, const double *dimensions, const double *axes, double *tensor)
{
    for (int64_t at = 0; at < n; ++at) {
        const double *l = dimensions + 3 * at, *a = axes + 9 * at;
        double s[9];
        for (int i = 0; i < 9; ++i) s[i] = l[i / 3] * a[i];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                tensor[9 * at + 3 * i + j] = s[i] * s[j] + s[3 + i] * s[3 + j] + s[6 + i] * s[6 + j];
    }
}
