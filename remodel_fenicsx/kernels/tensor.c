/* The repulsion `log` and the target of the law `tensor` at every point. Plain arrays in, plain arrays out; the Python
   functions that these stand for are listed in kernels/__init__.py and named below. Names in capitals that are not
   defined here are Python's: kernels/tensor.py writes them before the first line. */
#include <float.h>
#include "algebra.h"

/* tensors.first_divided_difference. */
static inline double first_difference(double a, double b)
{
    const double x = (a - b) / (a + b), square = x * x;
    return 2 / (a + b) * (fabs(x) < CLOSE ? 1 + square / 3 + square * square / 5 : atanh(x) / x);
}

/* tensors.second_divided_difference. */
static inline double second_difference(double a, double b, double c, double first, double last)
{
    if (!(c - a < CLOSE * c)) return (last - first) / (c - a);
    const double mean = (a + b + c) / 3, three[3] = {a / mean - 1, b / mean - 1, c / mean - 1};
    double p2 = 0, p3 = 0, p4 = 0;
    ALL(i) {
        const double square = three[i] * three[i];
        p2 += square, p3 += square * three[i], p4 += square * square;
    }
    return -(0.5 + p2 / 8 - p3 / 15 + p2 * p2 / 48 + p4 / 24) / (mean * mean);
}

/* tensors.first_divided_differences. */
static void first_differences(const double *c, tensor result)
{
    ALL(i) ALL(j) if (i <= j) result[i][j] = result[j][i] = i == j ? 1 / c[i] : first_difference(c[j], c[i]);
}

/* tensors.second_derivative. */
static void second_derivative(const double *c, tensor first, tensor A, matrix result)
{
    double f[3][3][3];
    ALL(i) ALL(j) ALL(k) if (i <= j && j <= k) {
        const double value = second_difference(c[i], c[j], c[k], first[i][j], first[j][k]);
        f[i][j][k] = f[i][k][j] = f[j][i][k] = f[j][k][i] = f[k][i][j] = f[k][j][i] = value;
    }
    MANDEL(r) for (int s = r; s < 6; ++s) {
        const int i = ROW[r], j = COLUMN[r];
        double sum = 0;
        for (int side = 0; side < 2; ++side) {
            const int p = side ? COLUMN[s] : ROW[s], q = side ? ROW[s] : COLUMN[s];
            if (q == j) sum += f[i][p][j] * A[i][p];
            if (p == i) sum += f[i][q][j] * A[q][j];
        }
        result[r][s] = result[s][r] = FACTOR[r] * FACTOR[s] / 2 * sum;
    }
}

/* energy.log_sum: A : ln C. */
void log_sum(int64_t n, const double *F, const double *A, double *result)
{
    for (int64_t at = 0; at < n; ++at) {
        tensor gradient, strain, basis, cells, inside;
        double c[3];
        memcpy(gradient, F + 9 * at, sizeof(tensor)), memcpy(cells, A + 9 * at, sizeof(tensor));
        strain_of(gradient, strain);
        eigen(strain, c, basis);
        rotated(cells, basis, 0, inside);
        result[at] = log(c[0]) * inside[0][0] + log(c[1]) * inside[1][1] + log(c[2]) * inside[2][2];
    }
}

/* energy.log_derivatives; second may be null. */
void log_derivatives(int64_t n, const double *C, const double *A, double *first, double *second)
{
    for (int64_t at = 0; at < n; ++at) {
        tensor strain, cells, basis, inside, quotients, value;
        double c[3];
        memcpy(strain, C + 9 * at, sizeof(tensor)), memcpy(cells, A + 9 * at, sizeof(tensor));
        eigen(strain, c, basis);
        rotated(cells, basis, 0, inside);
        first_differences(c, quotients);
        ALL(i) ALL(j) value[i][j] = quotients[i][j] * inside[i][j];
        rotated(value, basis, 1, strain);
        memcpy(first + 9 * at, strain, sizeof(tensor));
        if (!second) continue;
        matrix derivative, turn, outside;
        second_derivative(c, quotients, inside, derivative);
        congruence(basis, turn);
        turned(turn, derivative, outside);
        memcpy(second + 36 * at, outside, sizeof(matrix));
    }
}

/* tensor_law.target: the principal values of E, and s, from those of D. */
static double weights(const double *values, double floor, double *direction)
{
    double largest = 0, tension = 0, compression = 0;
    ALL(i) largest = fmax(largest, fabs(values[i]));
    const double unit = largest > 0 ? largest : 1, least = floor / unit;
    ALL(i) {
        const double value = values[i] / unit;
        direction[i] = value > 0 ? value * value : 0;
        tension += direction[i], compression += value < 0 ? value * value : 0;
    }
    const double total = tension + COMPRESSION * compression + least * least;
    ALL(i) direction[i] /= tension > 0 ? tension : 1;
    return tension / (total > 0 ? total : 1);
}

/* The same from F and tensors, of a spatial driver turned back by drivers.rotated_back. */
void target(int64_t n, const double *F, const double *tensors, int turned_back, const double *floor, double *direction,
            double *share)
{
    for (int64_t at = 0; at < n; ++at) {
        tensor D, R, basis, vectors;
        double values[3], weight[3], c[3];
        memcpy(D, tensors + 9 * at, sizeof(tensor));
        if (turned_back) {
            tensor gradient, C, in_basis;
            memcpy(gradient, F + 9 * at, sizeof(tensor));
            strain_of(gradient, C);
            eigen(C, c, basis);
            ALL(i) ALL(j) {
                R[i][j] = 0;
                ALL(k) R[i][j] += gradient[i][k] * basis[k][j] / sqrt(c[j]);
            }
            rotated(D, R, 0, in_basis);
            rotated(in_basis, basis, 1, D);
        }
        eigen(D, values, vectors);
        share[at] = weights(values, floor[at], weight);
        composed(weight, vectors, D);
        memcpy(direction + 9 * at, D, sizeof(tensor));
    }
}
