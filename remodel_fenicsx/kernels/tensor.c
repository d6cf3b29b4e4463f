/* The repulsion `log`, the target of the law `tensor`, and the local problem of implicit steps at every point. Plain
   arrays in, plain arrays out; the Python functions that these stand for are listed in kernels/__init__.py and named
   below. What is not solved here is marked, and numpy solves it. Names in capitals that are not defined here are
   Python's: kernels/tensor.py writes them before the first line. */
#include <float.h>
#include "algebra.h"

/* What is known here of the parts of the model, by the names that they have for it (`compiled`). Python asks for their
   numbers; a point with another one is marked as not solved. */
enum {
    WORMLIKE = 1, NEO_HOOKEAN, TENSOR, AFFINE, CAUCHY, PK2, FINGER, LOG, LENGTH, AXES, STAYS, TO_SPACE, PULLED_BACK
};

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

typedef struct {               /* of a point, as Python gives it: kernels/tensor.py, `CompiledProblem._given` */
    double parameter[PARAMETERS], floor, noise, rounding, kappa_dt;
    double lengths[3];         /* cells at the start of the step: l by rank, their axes as rows, and A */
    tensor axes, structure;
    double from[3], share;     /* of laws by rank: l = from + share r0 e */
} given;

typedef struct {               /* the parts of the model */
    int law, driver, repulsion, frame;
} parts;

typedef struct {               /* in the eigenbasis of C */
    tensor F, basis, R, old, axes;   /* F and the basis in the global one; F = R U; A and axes at the start */
    double c[3], u[3], J;
    const given *is;
    parts of;
} point;

typedef struct {
    tensor D, A, S, missing;   /* missing: what the cells make of D, less D */
    double values[3], direction[3], share, squared;   /* of X; of E in its basis, or e; s; r^2 */
    tensor vectors, n;         /* axes of X, as columns; of laws by rank the axes of the cells, as rows */
    double l[3], size;         /* and their lengths; |v+| */
    int active, open, short_enough, converged;   /* short_enough: r < L */
} state;

/* The eigenvalues of C and the basis are there. */
static void in_basis(point *p)
{
    tensor inside, structure;
    memcpy(structure, p->is->structure, sizeof(tensor));
    ALL(i) p->u[i] = sqrt(p->c[i]);
    p->J = p->u[0] * p->u[1] * p->u[2];
    rotated(structure, p->basis, 0, p->old);
    rotated(p->F, p->basis, 0, inside);
    ALL(i) ALL(j) {
        p->R[i][j] = inside[i][j] / p->u[j], p->axes[i][j] = 0;
        ALL(k) p->axes[i][j] += p->is->axes[i][k] * p->basis[k][j];
    }
}

/* Up to W points from the given one on, with D in their bases. */
static void prepare(int n, point *p, state *s, int64_t first, const double *F, const double *D, const double *all,
                    parts of)
{
    tensor C[W], basis[W], global;
    double c[W][3];
    for (int k = 0; k < n; ++k) {
        p[k].of = of, p[k].is = (const given *)all + first + k;
        memcpy(p[k].F, F + 9 * (first + k), sizeof(tensor));
        strain_of(p[k].F, C[k]);
    }
    eigen_of(n, C, c, basis);
    for (int k = 0; k < n; ++k) {
        memcpy(p[k].c, c[k], sizeof(c[k])), memcpy(p[k].basis, basis[k], sizeof(tensor));
        in_basis(p + k);
        memcpy(global, D + 9 * (first + k), sizeof(tensor));
        rotated(global, p[k].basis, 0, s[k].D);
    }
}

/* chains.wormlike_stiffness, and its slope by r. */
static inline double stiffness(double r, double L, double *slope)
{
    const double x = r / L, left = 1 - x;
    *slope = (3 - x) / (4 * left * left * left) / (L * L);
    return (1 + (2 - x) / (4 * left * left)) / L;
}

/* energy.Tissue.repulsion_modulus: c g(r0). */
static inline double repulsion_modulus(point *p)
{
    double ignored;
    const double *q = p->is->parameter;
    return q[NETWORK_MODULUS] * stiffness(q[END_TO_END_LENGTH], q[CONTOUR_LENGTH], &ignored);
}

/* n_I . C n_K of the axes of a cell, rows. */
static inline double strain_between(point *p, state *s, int I, int K)
{
    return s->n[I][0] * p->c[0] * s->n[K][0] + s->n[I][1] * p->c[1] * s->n[K][1] + s->n[I][2] * p->c[2] * s->n[K][2];
}

/* local_problem.axes_terms: the value. */
static void axes_terms(point *p, state *s, tensor G)
{
    double entries[3];
    tensor columns;
    ALL(I) entries[I] = s->l[I] * s->l[I] / strain_between(p, s, I, I);
    ALL(i) ALL(j) columns[i][j] = s->n[j][i];
    composed(entries, columns, G);
}

/* The same: its derivatives by the numbers of the cells and by C. */
static void axes_derivatives(point *p, state *s, matrix turn, matrix by_numbers, matrix by_strain)
{
    double steepness[3];
    matrix changes;
    memset(changes, 0, sizeof(matrix));
    ALL(I) {
        const double stretch = strain_between(p, s, I, I);
        changes[I][I] = 2 * s->l[I] / stretch;
        steepness[I] = -s->l[I] * s->l[I] / (stretch * stretch);
    }
    for (int row = 3; row < 6; ++row) {
        const int i = ROW[row], j = COLUMN[row];
        const double across = strain_between(p, s, i, j);
        changes[row][row] = ROOT_2 * (s->l[i] * s->l[i] / strain_between(p, s, i, i)
                                      - s->l[j] * s->l[j] / strain_between(p, s, j, j));
        changes[i][row] = 2 * steepness[i] * across;
        changes[j][row] = -2 * steepness[j] * across;
    }
    product(turn, changes, by_numbers);
    MANDEL(a) MANDEL(b) {
        by_strain[a][b] = 0;
        ALL(I) by_strain[a][b] += turn[a][I] * steepness[I] * turn[b][I];
    }
}

/* local_problem.stress with energy.neo_hookean_derivatives; the derivatives by A and by C may be null. For the
   repulsion `axes` they are those of the other terms. */
static void stress(point *p, state *s, matrix *by_cells, matrix *by_strain)
{
    const double *q = p->is->parameter, L = q[CONTOUR_LENGTH], r0 = q[END_TO_END_LENGTH];
    const double volumetric = q[LAME_LAMBDA] * log(p->J) - q[LAME_MU];
    const int repulsion = p->of.repulsion;
    double slope, squared = 0;
    ALL(i) squared += s->A[i][i] * p->c[i];
    const double r = sqrt(squared), along = q[NETWORK_MODULUS] * stiffness(r, L, &slope);
    const double against = repulsion_modulus(p);
    const double steep = q[NETWORK_MODULUS] * slope / (2 * r);
    tensor quotients, G;
    memset(G, 0, sizeof(tensor));
    if (repulsion == LOG) first_differences(p->c, quotients);
    else ALL(i) ALL(j) quotients[i][j] = repulsion == LENGTH ? r0 * r0 / squared : repulsion == AXES ? 0 : NAN;
    if (repulsion == AXES) axes_terms(p, s, G);
    s->squared = squared;
    ALL(i) ALL(j) s->S[i][j] = (along - against * quotients[i][j]) * s->A[i][j] - against * G[i][j];
    ALL(i) s->S[i][i] += volumetric / p->c[i] + q[LAME_MU];
    if (!by_cells) return;
    vector a;
    to_vector(s->A, a);
    if (repulsion == LOG) second_derivative(p->c, quotients, s->A, *by_strain);
    MANDEL(i) MANDEL(j) {
        const double across = repulsion == LENGTH ? against * r0 * r0 / (squared * squared) : 0;
        const double second = repulsion == LOG ? -against * (*by_strain)[i][j] : across * a[i] * a[j];
        const double matrix_part = i < 3 && j < 3 ? q[LAME_LAMBDA] / 2 / (p->c[i] * p->c[j]) : 0;
        (*by_strain)[i][j] = matrix_part + steep * a[i] * a[j] + second;
        (*by_cells)[i][j] = j < 3 ? (steep + across) * a[i] * p->c[j] : 0;
    }
    MANDEL(i) {
        (*by_strain)[i][i] -= volumetric / (p->c[ROW[i]] * p->c[COLUMN[i]]);
        (*by_cells)[i][i] += along - against * quotients[ROW[i]][COLUMN[i]];
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

/* tensor_law.target and tensor_law.follow: A from the values and axes of X. */
static void cells_of_tensor(point *p, state *s)
{
    const double r0 = p->is->parameter[END_TO_END_LENGTH], squared = r0 * r0;
    s->share = weights(s->values, p->is->floor, s->direction);
    const double weight = -expm1(-p->is->kappa_dt * s->share);
    tensor direction;
    composed(s->direction, s->vectors, direction);
    ALL(i) ALL(j) s->A[i][j] = p->old[i][j] + weight * (squared * direction[i][j] - p->old[i][j]);
}

/* local_problem.tensor_response with tensor_law.target_derivatives: dA/dX at a state that is there. */
static void tensor_by_tensor(point *p, state *s, matrix result)
{
    const double r0 = p->is->parameter[END_TO_END_LENGTH], squared = r0 * r0;
    double largest = 0, positive = 0, negative = 0, v[3], tension[3], slope[3];
    ALL(i) largest = fmax(largest, fabs(s->values[i]));
    const double unit = largest > 0 ? largest : 1;
    ALL(i) {
        v[i] = s->values[i] / unit, tension[i] = fmax(v[i], 0);
        positive += tension[i] * tension[i], negative += fmin(v[i], 0) * fmin(v[i], 0);
    }
    const double some = positive > 0 ? positive : 1, least = p->is->floor / unit;
    matrix by_values, turn;
    memset(by_values, 0, sizeof(matrix));
    ALL(i) ALL(j) by_values[i][j] = 2 * tension[j] / some * ((i == j) - tension[i] * tension[i] / some) / unit;
    for (int row = 3; row < 6; ++row) {
        const int i = ROW[row], j = COLUMN[row];
        const double more = fmax(tension[i], tension[j]), apart = fmax(fabs(v[i] - v[j]), DBL_MIN);
        by_values[row][row] = (v[i] > 0 && v[j] > 0 ? v[i] + v[j] : more * more / apart) / some / unit;
    }
    congruence(s->vectors, turn);
    turned(turn, by_values, result);
    const double against = COMPRESSION * negative + least * least, sum = positive + against, total = sum > 0 ? sum : 1;
    ALL(i) slope[i] = 2 * (tension[i] * against - COMPRESSION * positive * fmin(v[i], 0)) / (total * total * unit);
    const double left = exp(-p->is->kappa_dt * s->share), weight = squared * -expm1(-p->is->kappa_dt * s->share);
    MANDEL(a) {
        double way = 0;
        ALL(k) way += turn[a][k] * s->direction[k];
        way = squared * way - FACTOR[a] * p->old[ROW[a]][COLUMN[a]];
        MANDEL(b) {
            double share = 0;
            ALL(k) share += turn[b][k] * slope[k];
            result[a][b] = weight * result[a][b] + p->is->kappa_dt * left * way * share;
        }
    }
}

/* drivers.material_frame with F = U: n from the axes m of X, columns. */
static void pull_back(point *p, state *s)
{
    double second[3], along = 0;
    ALL(i) s->n[0][i] = s->vectors[i][0] / p->u[i];
    normalise(s->n[0], s->n[0]);
    ALL(i) along += s->n[0][i] * s->vectors[i][1] / p->u[i];
    ALL(i) second[i] = s->vectors[i][1] / p->u[i] - along * s->n[0][i];
    normalise(second, s->n[1]);
    cross(s->n[0], s->n[1], s->n[2]);
}

static inline void swap(double *a, double *b)
{
    const double first = *a;
    *a = *b, *b = first;
}

/* laws.by_rank: lengths and axes from the values and axes of X. Where values agree it is left open. */
static void cells_by_rank(point *p, state *s)
{
    double length = 0;
    swap(s->values, s->values + 2);
    ALL(i) swap(s->vectors[i], s->vectors[i] + 2);
    const double largest = fmax(fabs(s->values[0]), fabs(s->values[2]));
    const double equal = fmax(AGREE * largest, p->is->noise), least = fmax(ROUNDING * largest, p->is->noise);
    ALL(I) {
        s->direction[I] = s->values[I] > least ? s->values[I] / largest : 0;
        length += s->direction[I] * s->direction[I];
    }
    length = sqrt(length);
    s->size = length * largest;
    s->active = length > 0 && p->is->share > 0;
    s->open = s->active && !(s->values[0] - s->values[1] > equal && s->values[1] - s->values[2] > equal);
    ALL(I) {
        if (length > 0) s->direction[I] /= length;
        const double towards = p->is->share * p->is->parameter[END_TO_END_LENGTH] * s->direction[I];
        s->l[I] = s->active ? p->is->from[I] + towards : p->is->lengths[I];
        ALL(i) s->n[I][i] = s->active ? s->vectors[i][I] : p->axes[I][i];
    }
    if (s->active && p->of.frame == PULLED_BACK) pull_back(p, s);
    ALL(i) ALL(j) {
        s->A[i][j] = 0;
        ALL(I) s->A[i][j] += s->l[I] * s->l[I] * s->n[I][i] * s->n[I][j];
    }
}

/* To the basis from the axes of the cell: local_problem.to_axes. */
static void from_axes(state *s, matrix turn)
{
    tensor columns;
    ALL(i) ALL(j) columns[i][j] = s->n[j][i];
    congruence(columns, turn);
}

/* local_problem.LocalCells.structure_by_cells: dA/dy. */
static void structure_by_numbers(state *s, matrix turn, matrix result)
{
    MANDEL(a) MANDEL(b) {
        const int i = ROW[b], j = COLUMN[b];
        result[a][b] = turn[a][b] * (b < 3 ? 2 * s->l[b] : ROOT_2 * (s->l[i] * s->l[i] - s->l[j] * s->l[j]));
    }
}

/* local_problem._pulled_back: turns of n by those of m, and by dU, which dC makes here. */
static void turns_pulled_back(point *p, state *s, double by_turns[3][3], matrix by_strain)
{
    tensor L, inverse;
    ALL(I) ALL(K) {
        L[I][K] = inverse[I][K] = 0;
        ALL(i) {
            L[I][K] += s->vectors[i][I] * s->n[K][i] / p->u[i];
            inverse[I][K] += s->n[I][i] * p->u[i] * s->vectors[i][K];
        }
    }
    memset(by_strain, 0, sizeof(matrix));
    for (int row = 3; row < 6; ++row) {
        const int i = ROW[row], j = COLUMN[row];
        ALL(pair) {
            const int a = ROW[3 + pair], b = COLUMN[3 + pair];
            by_turns[row - 3][pair] = inverse[i][a] * L[b][j] - inverse[i][b] * L[a][j];
        }
        MANDEL(b) {
            const int k = ROW[b], l = COLUMN[b];
            const double dyad = s->n[i][k] * s->n[j][l] / p->u[l] + s->n[i][l] * s->n[j][k] / p->u[k];
            by_strain[row][b] = -FACTOR[b] * dyad / 2 / (p->u[k] + p->u[l]);
        }
    }
}

/* local_problem.ranked_response: dy/dX, and dy/dC. */
static void ranks_by_tensor(point *p, state *s, matrix result, matrix by_strain)
{
    matrix inside, turn;
    tensor rows;
    const double steepness = p->is->share * p->is->parameter[END_TO_END_LENGTH] / s->size;
    memset(inside, 0, sizeof(matrix)), memset(by_strain, 0, sizeof(matrix)), memset(result, 0, sizeof(matrix));
    if (!s->active) return;
    ALL(i) ALL(j) if (s->direction[j] > 0)
        inside[i][j] = steepness * ((i == j) - s->direction[i] * s->direction[j]);
    double by_turns[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    if (p->of.frame == PULLED_BACK) turns_pulled_back(p, s, by_turns, by_strain);
    ALL(row) ALL(pair) {
        const double gap = s->values[ROW[3 + pair]] - s->values[COLUMN[3 + pair]];
        inside[3 + row][3 + pair] = by_turns[row][pair] / (ROOT_2 * gap);
    }
    ALL(i) ALL(j) rows[i][j] = s->vectors[j][i];
    congruence(rows, turn);
    product(inside, turn, result);
}

/* Driver.derivatives: what a stress makes of D, and the factors of its derivative by the stress. */
static inline double by_stress(point *p, int i, int j)
{
    if (p->of.driver == CAUCHY) return p->u[i] * p->u[j] / p->J;
    return p->of.driver == PK2 ? 1 : p->of.driver == FINGER ? 0 : NAN;
}

static void drive(point *p, tensor S, tensor D)
{
    ALL(i) ALL(j) D[i][j] = p->of.driver == FINGER ? (i == j) * p->c[i] : by_stress(p, i, j) * S[i][j];
}

/* Its derivative by C at fixed stress. */
static void drive_by_strain(point *p, tensor S, matrix result)
{
    memset(result, 0, sizeof(matrix));
    if (p->of.driver == FINGER) MANDEL(a) result[a][a] = 1;
    if (p->of.driver != CAUCHY) return;
    tensor D;
    drive(p, S, D);
    MANDEL(b) {
        tensor stretch, change;
        memset(stretch, 0, sizeof(tensor));
        const int k = ROW[b], l = COLUMN[b];
        stretch[k][l] = stretch[l][k] = 1 / FACTOR[b] / (p->u[k] + p->u[l]);
        ALL(i) ALL(j) {
            change[i][j] = 0;
            ALL(m) change[i][j] += (stretch[i][m] * S[m][j] * p->u[j] + p->u[i] * S[i][m] * stretch[m][j]) / p->J;
            if (b < 3) change[i][j] -= D[i][j] / (2 * p->c[b]);
        }
        MANDEL(a) result[a][b] = FACTOR[a] * change[ROW[a]][COLUMN[a]];
    }
}

/* The tensor X whose axes a law asks for: D where it lives; by rank as local_problem._drive has it. */
static void driven(point *p, state *s, tensor X)
{
    tensor carried, as_it_is;
    if (p->of.driver == FINGER) drive(p, s->S, s->D);
    if (p->of.frame == TO_SPACE) rotated(s->D, p->R, 1, X);
    else memcpy(X, s->D, sizeof(tensor));
    if (p->of.law != AFFINE) return;
    memcpy(as_it_is, X, sizeof(tensor));
    ALL(I) ALL(i) carried[I][i] = p->axes[I][i] * (p->of.frame == PULLED_BACK ? p->u[i] : 1);
    steady(&as_it_is[0][0], &carried[0][0], p->is->rounding, &X[0][0]);
}

/* local_problem.LocalProblem._trial: all that D says, at up to W points. */
static void evaluate(int n, point **p, state **s)
{
    tensor X[W], vectors[W], D;
    double values[W][3];
    for (int k = 0; k < n; ++k) driven(p[k], s[k], X[k]);
    eigen_of(n, X, values, vectors);
    for (int k = 0; k < n; ++k) {
        state *of = s[k];
        memcpy(of->values, values[k], sizeof(values[k])), memcpy(of->vectors, vectors[k], sizeof(tensor));
        of->open = p[k]->of.law != TENSOR && p[k]->of.law != AFFINE;
        if (p[k]->of.law == TENSOR) cells_of_tensor(p[k], of);
        if (p[k]->of.law == AFFINE) cells_by_rank(p[k], of);
        stress(p[k], of, 0, 0);
        drive(p[k], of->S, D);
        ALL(i) ALL(j) of->missing[i][j] = D[i][j] - of->D[i][j];
        of->short_enough = sqrt(of->squared) < p[k]->is->parameter[CONTOUR_LENGTH];
        of->converged = norm(of->missing) <= TOLERANCE * norm(of->D) + p[k]->is->rounding && of->short_enough;
        if (p[k]->of.driver == FINGER) of->converged = isfinite(norm(of->S));
        of->converged = of->converged && !of->open;
    }
}

/* local_problem.LocalProblem._linearised: 1 - dD/dS dS/dy dy/dD, and dS/dy dy/dD and dS/dC with it. */
static void equation(point *p, state *s, matrix result, matrix through_cells, matrix direct)
{
    matrix by_structure, by_tensor, turn, inside;
    stress(p, s, &by_structure, (matrix *)direct);
    if (p->of.law == TENSOR) {
        tensor_by_tensor(p, s, by_tensor);
        product(by_structure, by_tensor, through_cells);
    } else {
        matrix by_numbers, structure, by_strain, more;
        from_axes(s, turn);
        structure_by_numbers(s, turn, structure);
        product(by_structure, structure, by_numbers);
        if (p->of.repulsion == AXES) {
            const double modulus = repulsion_modulus(p);
            axes_derivatives(p, s, turn, structure, more);
            MANDEL(a) MANDEL(b) by_numbers[a][b] -= modulus * structure[a][b], direct[a][b] -= modulus * more[a][b];
        }
        ranks_by_tensor(p, s, by_tensor, by_strain);
        product(by_numbers, by_tensor, through_cells);
        if (p->of.frame == PULLED_BACK) {
            product(by_numbers, by_strain, more);
            MANDEL(a) MANDEL(b) direct[a][b] += more[a][b];
        }
    }
    if (p->of.frame == TO_SPACE) {
        congruence(p->R, turn);
        memcpy(inside, through_cells, sizeof(matrix));
        product(inside, turn, through_cells);
    }
    MANDEL(a) MANDEL(b) result[a][b] = (a == b) - by_stress(p, ROW[a], COLUMN[a]) * through_cells[a][b];
}

/* local_problem.LocalProblem._better: a step not longer than D. */
static void newton_step(point *p, state *s, tensor step)
{
    matrix left, through_cells, direct;
    vector change;
    equation(p, s, left, through_cells, direct);
    to_vector(s->missing, change);
    divide(left, change, 1);
    to_tensor(change, step);
    const double length = norm(step), size = fmax(norm(s->D), norm(s->missing));
    const double share = length > 0 ? fmin(1, size / length) : 1;
    ALL(i) ALL(j) step[i][j] = isfinite(length) ? share * step[i][j] : 0;
}

/* The same of up to W points; halved where it leads to r >= L. */
static void iterate(int n, point **p, state **s)
{
    tensor steps[W];
    point *tried[W];
    state next[W], *trials[W];
    for (int k = 0; k < n; ++k) newton_step(p[k], s[k], steps[k]);
    double share = 1;
    for (int halving = 0; halving <= HALVINGS; ++halving, share /= 2) {
        int count = 0;
        for (int k = 0; k < n; ++k) {
            if (halving && next[k].short_enough) continue;
            ALL(i) ALL(j) next[k].D[i][j] = s[k]->D[i][j] + share * steps[k][i][j];
            tried[count] = p[k], trials[count++] = next + k;
        }
        if (!count) break;
        evaluate(count, tried, trials);
    }
    for (int k = 0; k < n; ++k) *s[k] = next[k];
}

/* Up to W points from the given one on, all that D says of them, and where they are; returns how many. */
static int begin(int64_t n, int64_t first, point *p, state *s, point **points, state **states, const double *F,
                 const double *D, const double *all, parts of)
{
    const int count = n - first < W ? (int)(n - first) : W;
    for (int k = 0; k < count; ++k) points[k] = p + k, states[k] = s + k;
    prepare(count, p, s, first, F, D, all, of);
    evaluate(count, points, states);
    return count;
}

/* local_problem.LocalProblem.solve, from start; all results in the global basis. open: where it is left to numpy. */
void solve(int64_t n, const double *F, const double *start, const double *given, int law, int driver, int repulsion,
           int frame, double *tensors, double *structure, double *stresses, double *squared, uint8_t *converged,
           uint8_t *open)
{
    const parts of = {law, driver, repulsion, frame};
    point p[W], *points[W];
    state s[W], *states[W];
    for (int64_t first = 0; first < n; first += W) {
        const int count = begin(n, first, p, s, points, states, F, start, given, of);
        for (int iteration = 0; iteration < ITERATIONS && driver != FINGER; ++iteration) {
            int left = 0;
            for (int k = 0; k < count; ++k)
                if (!s[k].converged && !s[k].open) points[left] = p + k, states[left++] = s + k;
            if (!left) break;
            iterate(left, points, states);
        }
        for (int k = 0; k < count; ++k) {
            const int64_t at = first + k;
            tensor global, P;
            rotated(s[k].D, p[k].basis, 1, global);
            memcpy(tensors + 9 * at, global, sizeof(tensor));
            rotated(s[k].A, p[k].basis, 1, global);
            memcpy(structure + 9 * at, global, sizeof(tensor));
            rotated(s[k].S, p[k].basis, 1, global);
            ALL(i) ALL(j) {
                P[i][j] = 0;
                ALL(m) P[i][j] += p[k].F[i][m] * global[m][j];
            }
            memcpy(stresses + 9 * at, P, sizeof(tensor));
            squared[at] = s[k].squared, converged[at] = s[k].converged, open[at] = s[k].open;
        }
    }
}

/* local_problem.Strain.by_gradient (6, 9), and of laws in space what a turn R W makes of D as they see it, W D - D W,
   by the gradient (6, 9). */
static void by_gradient(point *p, tensor D, double strain[6][9], double turned[6][9])
{
    tensor carried;   /* F Q = R Q U */
    memset(turned, 0, 54 * sizeof(double));
    ALL(i) ALL(j) {
        carried[i][j] = 0;
        ALL(k) carried[i][j] += p->F[i][k] * p->basis[k][j];
    }
    MANDEL(a) ALL(k) ALL(L) {
        const int i = ROW[a], j = COLUMN[a];
        strain[a][3 * k + L] = FACTOR[a] * (carried[k][i] * p->basis[L][j] + carried[k][j] * p->basis[L][i]);
    }
    if (p->of.frame != TO_SPACE) return;
    for (int row = 3; row < 6; ++row) {
        const int i = ROW[row], j = COLUMN[row];
        tensor change;
        memset(change, 0, sizeof(tensor));
        ALL(k) change[i][k] += D[j][k], change[j][k] -= D[i][k];   /* W D; its transpose is - D W */
        MANDEL(a) ALL(k) ALL(L) {
            const double turn = carried[k][i] / p->u[i] * p->basis[L][j] - carried[k][j] / p->u[j] * p->basis[L][i];
            const double both = change[ROW[a]][COLUMN[a]] + change[COLUMN[a]][ROW[a]];
            turned[a][3 * k + L] += FACTOR[a] * both * turn / (p->u[i] + p->u[j]);
        }
    }
}

/* M N, and a matrix (6, 9) that is added to. */
static void add_product(matrix m, double n[6][9], double result[6][9])
{
    MANDEL(a) MANDEL(b) for (int c = 0; c < 9; ++c) result[a][c] += m[a][b] * n[b][c];
}

/* local_problem.LocalProblem.tangent at one solved point. */
static void slopes(point *p, state *s, double *result, double slope[6][9])
{
    tensor outside;
    matrix left, through_cells, direct, by_strain;
    double strain[6][9], turned[6][9], change[6][9] = {{0}}, right[6][9] = {{0}};   /* change: dS/dF */
    equation(p, s, left, through_cells, direct);
    drive_by_strain(p, s->S, by_strain);
    by_gradient(p, s->D, strain, turned);
    add_product(direct, strain, change), add_product(through_cells, turned, change);
    add_product(by_strain, strain, right);
    MANDEL(a) for (int c = 0; c < 9; ++c) right[a][c] += by_stress(p, ROW[a], COLUMN[a]) * change[a][c];
    divide(left, &right[0][0], 9);
    memset(slope, 0, sizeof(right));
    congruence(p->basis, by_strain);
    add_product(by_strain, right, slope);
    add_product(through_cells, right, change);
    rotated(s->S, p->basis, 1, outside);
    for (int r = 0; r < 9; ++r)
        for (int c = 0; c < 9; ++c) {
            double sum = r / 3 == c / 3 ? outside[r % 3][c % 3] : 0;
            MANDEL(a) sum += strain[a][r] * change[a][c] / 2;
            result[9 * r + c] = sum;
        }
}

/* local_problem.LocalProblem.tangent at solved points: dP/dF (9, 9), and dD/dF (6, 9) in the global basis; open: where
   it is left to numpy. */
void tangent(int64_t n, const double *F, const double *tensors, const double *given, int law, int driver,
             int repulsion, int frame, double *result, double *slope, uint8_t *open)
{
    const parts of = {law, driver, repulsion, frame};
    point p[W], *points[W];
    state s[W], *states[W];
    for (int64_t first = 0; first < n; first += W) {
        const int count = begin(n, first, p, s, points, states, F, tensors, given, of);
        for (int k = 0; k < count; ++k) {
            slopes(p + k, s + k, result + 81 * (first + k), (double (*)[9])(slope + 54 * (first + k)));
            open[first + k] = s[k].open;
        }
    }
}
