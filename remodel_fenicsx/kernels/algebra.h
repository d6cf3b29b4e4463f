/* Tensors of one point: eigenvalues, Mandel matrices. */
#ifndef ALGEBRA_H
#define ALGEBRA_H
#include <math.h>
#include <stdint.h>
#include <string.h>
#include "principal.h"

#define ROOT_2 1.4142135623730951
#define ALL(i) for (int i = 0; i < 3; ++i)
#define MANDEL(i) for (int i = 0; i < 6; ++i)
typedef double tensor[3][3];
typedef double matrix[6][6];   /* a linear map between symmetric tensors */

static const int ROW[6] = {0, 1, 2, 1, 0, 0}, COLUMN[6] = {0, 1, 2, 2, 2, 1};
static const double FACTOR[6] = {1, 1, 1, ROOT_2, ROOT_2, ROOT_2};

/* tensors.rotated: Q^T t Q, or Q t Q^T. */
static inline void rotated(tensor t, tensor q, int back, tensor result)
{
    tensor half;
    ALL(i) ALL(j) {
        half[i][j] = 0;
        ALL(k) half[i][j] += t[i][k] * (back ? q[j][k] : q[k][j]);
    }
    ALL(i) ALL(j) {
        double sum = 0;
        ALL(k) sum += (back ? q[i][k] : q[k][i]) * half[k][j];
        result[i][j] = sum;
    }
}

/* A symmetric tensor from its principal values and, as columns, axes. */
static inline void composed(const double *values, tensor vectors, tensor result)
{
    ALL(i) ALL(j) {
        result[i][j] = 0;
        ALL(k) result[i][j] += vectors[i][k] * values[k] * vectors[j][k];
    }
}

/* C = F^T F. */
static inline void strain_of(tensor F, tensor C)
{
    ALL(i) ALL(j) {
        C[i][j] = 0;
        ALL(k) C[i][j] += F[k][i] * F[k][j];
    }
}

/* tensors.congruence. */
static void congruence(tensor q, matrix result)
{
    MANDEL(r) MANDEL(s) {
        const int i = ROW[r], j = COLUMN[r], a = ROW[s], b = COLUMN[s];
        result[r][s] = (q[i][a] * q[j][b] + q[i][b] * q[j][a]) * FACTOR[r] * FACTOR[s] / 2;
    }
}

static void product(matrix a, matrix b, matrix result)
{
    memset(result, 0, sizeof(matrix));
    MANDEL(i) MANDEL(k) MANDEL(j) result[i][j] += a[i][k] * b[k][j];
}

/* T M T^T. */
static void turned(matrix turn, matrix m, matrix result)
{
    matrix half;
    product(turn, m, half);
    MANDEL(i) MANDEL(j) {
        double sum = 0;
        MANDEL(k) sum += half[i][k] * turn[j][k];
        result[i][j] = sum;
    }
}

/* tensors.eigen of up to W tensors: ascending values, vectors as columns. */
static void eigen_of(int n, tensor *t, double (*values)[3], tensor *vectors)
{
    lanes a[6], axes[3][3];
    double scale[W];
    EACH {
        const int at = k < n ? k : n - 1;
        scale[k] = 0;
        ALL(i) ALL(j) scale[k] = fmax(scale[k], fabs(t[at][i][j]));
        if (!(scale[k] > 0)) scale[k] = 1;
        MANDEL(i) a[i][k] = (t[at][ROW[i]][COLUMN[i]] + t[at][COLUMN[i]][ROW[i]]) / 2 / scale[k];
    }
    jacobi(a, axes);
    for (int k = 0; k < n; ++k) ALL(i) {
        values[k][i] = scale[k] * a[2 - i][k];
        ALL(j) vectors[k][j][i] = axes[2 - i][j][k];
    }
}

static void eigen(tensor t, double *values, tensor vectors)
{
    eigen_of(1, (tensor *)t, (double (*)[3])values, (tensor *)vectors);
}
#endif
