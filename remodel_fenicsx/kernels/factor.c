/* A factor L L^T of a sparse positive definite matrix in single precision, by CHOLMOD.

   A kept factor only begins a quasi-Newton step, so seven digits are enough: for half of the time and of the memory.
   Matrix and right-hand sides are scaled to 1, so that no unit of force leaves the range of a float. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <suitesparse/cholmod.h>

typedef struct {
    cholmod_common common;
    cholmod_sparse *matrix; /* columns of the upper triangle */
    cholmod_factor *factor;
    cholmod_dense *right, *answer, *work[2];
    int32_t *entries; /* of the whole matrix, by row: which the triangle has */
    double scale;
} Factor;

/* Frees a factor. */
void factor_free(intptr_t handle)
{
    Factor *f = (Factor *)handle;
    cholmod_common *common = &f->common;
    cholmod_free_dense(&f->right, common);
    cholmod_free_dense(&f->answer, common);
    cholmod_free_dense(&f->work[0], common);
    cholmod_free_dense(&f->work[1], common);
    cholmod_free_factor(&f->factor, common);
    cholmod_free_sparse(&f->matrix, common);
    cholmod_finish(common);
    free(f->entries);
    free(f);
}

/* A factor for matrices of n rows with these entries, sorted; 0 where memory is short. */
intptr_t factor_new(int32_t n, const int32_t *starts, const int32_t *columns)
{
    Factor *f = calloc(1, sizeof *f);
    if (!f)
        return 0;
    cholmod_start(&f->common);
    f->common.supernodal = CHOLMOD_SUPERNODAL;
    f->common.print = 0;
    f->entries = malloc((size_t)(starts[n] > 0 ? starts[n] : 1) * sizeof *f->entries);
    f->matrix = cholmod_allocate_sparse(n, n, starts[n], 1, 1, 1, CHOLMOD_REAL + CHOLMOD_SINGLE, &f->common);
    f->right = cholmod_zeros(n, 1, CHOLMOD_REAL + CHOLMOD_SINGLE, &f->common);
    if (f->entries && f->matrix && f->right) {
        int32_t *first = f->matrix->p, *row = f->matrix->i, count = 0;
        for (int32_t i = 0; i < n; i++) { /* row i of the lower triangle is column i of the upper one */
            first[i] = count;
            for (int32_t k = starts[i]; k < starts[i + 1]; k++)
                if (columns[k] <= i) {
                    row[count] = columns[k];
                    f->entries[count++] = k;
                }
        }
        first[n] = count;
        f->factor = cholmod_analyze(f->matrix, &f->common);
    }
    if (f->factor)
        return (intptr_t)f;
    factor_free((intptr_t)f);
    return 0;
}

/* Factorises a matrix, whose entries are given; 0 where it is not positive definite in single precision. */
int factor_renew(intptr_t handle, const double *values)
{
    Factor *f = (Factor *)handle;
    const int32_t count = ((int32_t *)f->matrix->p)[f->matrix->ncol];
    float *of_triangle = f->matrix->x;
    double largest = 0.0;
    for (int32_t k = 0; k < count; k++)
        largest = fmax(largest, fabs(values[f->entries[k]]));
    f->scale = largest > 0.0 && isfinite(largest) ? 1.0 / largest : 1.0;
    for (int32_t k = 0; k < count; k++)
        of_triangle[k] = (float)(f->scale * values[f->entries[k]]);
    return cholmod_factorize(f->matrix, f->factor, &f->common) && f->common.status == CHOLMOD_OK &&
           f->factor->minor == f->factor->n;
}

/* Solves for one right-hand side; 0 where that fails, or where a number of it is not finite. */
int factor_solve(intptr_t handle, const double *right, double *answer)
{
    Factor *f = (Factor *)handle;
    const size_t n = f->matrix->ncol;
    float *from = f->right->x;
    double largest = 0.0;
    for (size_t i = 0; i < n; i++) {
        if (!isfinite(right[i]))
            return 0;
        largest = fmax(largest, fabs(right[i]));
    }
    const double size = largest > 0.0 ? largest : 1.0;
    for (size_t i = 0; i < n; i++)
        from[i] = (float)(right[i] / size);
    if (!cholmod_solve2(CHOLMOD_A, f->factor, f->right, NULL, &f->answer, NULL, &f->work[0], &f->work[1], &f->common))
        return 0;
    for (size_t i = 0; i < n; i++)
        answer[i] = size * f->scale * ((const float *)f->answer->x)[i];
    return 1;
}
