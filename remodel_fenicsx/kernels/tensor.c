/* The law `tensor` and the repulsion `log` at every point. Plain arrays in, plain arrays out; the Python functions that
   these stand for are listed in kernels/__init__.py and named below. What is not solved here is marked, and numpy solves
   it. Names in capitals that are not defined here are Python's: kernels/tensor.py writes them before the first line. */
#include <float.h>
#include "algebra.h"

/* What is known here of the parts of the model, by the names that they have for it (`compiled`). Python asks for their
   numbers; a point with another one is marked as not solved. */
enum {
    WORMLIKE = 1, NEO_HOOKEAN, TENSOR, CAUCHY, PK2, FINGER, LOG, LENGTH
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

typedef struct {               /* in the eigenbasis of C */
    tensor F, basis, old;      /* F and the basis in the global one; A at the start of the step */
    double c[3], u[3], J, parameter[PARAMETERS], floor, solved, kappa_dt;
    int driver, repulsion;
} point;

typedef struct {
    tensor D, A, S, missing;   /* missing: what the cells make of D, less D */
    double values[3], direction[3], share, squared;   /* of D, of E in its basis; s; r^2 */
    tensor vectors;
    int converged;
} state;

static void prepare(point *p, int64_t n, int64_t at, const double *F, const double *old, const double *parameters,
                    double floor, double solved, const double *kappa_dt, int driver, int repulsion)
{
    tensor C, global;
    memcpy(p->F, F + 9 * at, sizeof(tensor)), memcpy(global, old + 9 * at, sizeof(tensor));
    strain_of(p->F, C);
    eigen(C, p->c, p->basis);
    rotated(global, p->basis, 0, p->old);
    ALL(i) p->u[i] = sqrt(p->c[i]);
    p->J = p->u[0] * p->u[1] * p->u[2];
    for (int k = 0; k < PARAMETERS; ++k) p->parameter[k] = parameters[k * n + at];
    p->floor = floor, p->solved = solved, p->kappa_dt = kappa_dt[at], p->driver = driver, p->repulsion = repulsion;
}

/* chains.wormlike_stiffness, and its slope by r. */
static inline double stiffness(double r, double L, double *slope)
{
    const double x = r / L, left = 1 - x;
    *slope = (3 - x) / (4 * left * left * left) / (L * L);
    return (1 + (2 - x) / (4 * left * left)) / L;
}

/* local_problem.stress with energy.neo_hookean_derivatives; the derivatives by A and by C may be null. */
static void stress(point *p, state *s, matrix *by_cells, matrix *by_strain)
{
    const double *q = p->parameter, L = q[CONTOUR_LENGTH], r0 = q[END_TO_END_LENGTH];
    const double volumetric = q[LAME_LAMBDA] * log(p->J) - q[LAME_MU];
    double slope, ignored, squared = 0;
    ALL(i) squared += s->A[i][i] * p->c[i];
    const double r = sqrt(squared), along = q[NETWORK_MODULUS] * stiffness(r, L, &slope);
    const double against = q[NETWORK_MODULUS] * stiffness(r0, L, &ignored);
    const double steep = q[NETWORK_MODULUS] * slope / (2 * r);
    tensor quotients;
    if (p->repulsion == LOG) first_differences(p->c, quotients);
    else ALL(i) ALL(j) quotients[i][j] = p->repulsion == LENGTH ? r0 * r0 / squared : NAN;
    s->squared = squared;
    ALL(i) ALL(j) s->S[i][j] = (along - against * quotients[i][j]) * s->A[i][j];
    ALL(i) s->S[i][i] += volumetric / p->c[i] + q[LAME_MU];
    if (!by_cells) return;
    vector a;
    to_vector(s->A, a);
    if (p->repulsion == LOG) second_derivative(p->c, quotients, s->A, *by_strain);
    MANDEL(i) MANDEL(j) {
        const double across = p->repulsion == LOG ? 0 : against * r0 * r0 / (squared * squared);
        const double second = p->repulsion == LOG ? -against * (*by_strain)[i][j] : across * a[i] * a[j];
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

/* tensor_law.target and tensor_law.follow: A from D. */
static void cells(point *p, state *s)
{
    const double squared = p->parameter[END_TO_END_LENGTH] * p->parameter[END_TO_END_LENGTH];
    eigen(s->D, s->values, s->vectors);
    s->share = weights(s->values, p->floor, s->direction);
    const double weight = -expm1(-p->kappa_dt * s->share);
    tensor direction;
    composed(s->direction, s->vectors, direction);
    ALL(i) ALL(j) s->A[i][j] = p->old[i][j] + weight * (squared * direction[i][j] - p->old[i][j]);
}

/* local_problem.tensor_response with tensor_law.target_derivatives: dA/dD at a state that is there. */
static void cells_by_tensor(point *p, state *s, matrix result)
{
    const double squared = p->parameter[END_TO_END_LENGTH] * p->parameter[END_TO_END_LENGTH];
    double largest = 0, positive = 0, negative = 0, v[3], tension[3], slope[3];
    ALL(i) largest = fmax(largest, fabs(s->values[i]));
    const double unit = largest > 0 ? largest : 1;
    ALL(i) {
        v[i] = s->values[i] / unit, tension[i] = fmax(v[i], 0);
        positive += tension[i] * tension[i], negative += fmin(v[i], 0) * fmin(v[i], 0);
    }
    const double some = positive > 0 ? positive : 1, least = p->floor / unit;
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
    const double left = exp(-p->kappa_dt * s->share), weight = squared * -expm1(-p->kappa_dt * s->share);
    MANDEL(a) {
        double way = 0;
        ALL(k) way += turn[a][k] * s->direction[k];
        way = squared * way - FACTOR[a] * p->old[ROW[a]][COLUMN[a]];
        MANDEL(b) {
            double share = 0;
            ALL(k) share += turn[b][k] * slope[k];
            result[a][b] = weight * result[a][b] + p->kappa_dt * left * way * share;
        }
    }
}

/* Driver.derivatives: what a stress makes of D, and the factors of its derivative by the stress. */
static inline double by_stress(point *p, int i, int j)
{
    if (p->driver == CAUCHY) return p->u[i] * p->u[j] / p->J;
    return p->driver == PK2 ? 1 : p->driver == FINGER ? 0 : NAN;
}

static void drive(point *p, tensor S, tensor D)
{
    ALL(i) ALL(j) D[i][j] = p->driver == FINGER ? (i == j) * p->c[i] : by_stress(p, i, j) * S[i][j];
}

/* Its derivative by C at fixed stress. */
static void drive_by_strain(point *p, tensor S, matrix result)
{
    memset(result, 0, sizeof(matrix));
    if (p->driver == FINGER) MANDEL(a) result[a][a] = 1;
    if (p->driver != CAUCHY) return;
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

/* local_problem.LocalProblem._trial: all that D says. */
static void evaluate(point *p, state *s)
{
    tensor D;
    if (p->driver == FINGER) drive(p, s->S, s->D);
    cells(p, s);
    stress(p, s, 0, 0);
    drive(p, s->S, D);
    ALL(i) ALL(j) s->missing[i][j] = D[i][j] - s->D[i][j];
    const double extension = sqrt(s->squared) / p->parameter[CONTOUR_LENGTH];
    s->converged = norm(s->missing) <= TOLERANCE * norm(s->D) + p->solved && extension < 1;
    if (p->driver == FINGER) s->converged = isfinite(norm(s->S));
}

/* 1 - dD/dS dS/dA dA/dD, and dS/dA dA/dD and dS/dC with it. */
static void equation(point *p, state *s, matrix result, matrix through_cells, matrix direct)
{
    matrix by_cells, by_tensor;
    stress(p, s, &by_cells, (matrix *)direct);
    cells_by_tensor(p, s, by_tensor);
    product(by_cells, by_tensor, through_cells);
    MANDEL(a) MANDEL(b) result[a][b] = (a == b) - by_stress(p, ROW[a], COLUMN[a]) * through_cells[a][b];
}

/* local_problem.LocalProblem._better: a step not longer than D, halved where it leads to r >= L. */
static void iterate(point *p, state *s)
{
    matrix left, through_cells, direct;
    vector change;
    tensor step;
    state next;
    equation(p, s, left, through_cells, direct);
    to_vector(s->missing, change);
    divide(left, change, 1);
    to_tensor(change, step);
    const double length = norm(step), size = fmax(norm(s->D), norm(s->missing));
    double share = length > 0 ? fmin(1, size / length) : 1;
    const int finite = isfinite(length);
    for (int halving = 0; halving <= HALVINGS; ++halving, share /= 2) {
        ALL(i) ALL(j) next.D[i][j] = s->D[i][j] + (finite ? share * step[i][j] : 0);
        evaluate(p, &next);
        if (sqrt(next.squared) < p->parameter[CONTOUR_LENGTH]) break;
    }
    *s = next;
}

/* local_problem.LocalProblem.solve, from start; all results in the global basis. */
void solve(int64_t n, const double *F, const double *start, const double *old, const double *parameters,
           double floor, double solved, const double *kappa_dt, int driver, int repulsion, double *tensors,
           double *structure, double *stresses, double *squared, uint8_t *converged)
{
    for (int64_t at = 0; at < n; ++at) {
        point p;
        state s;
        tensor global, P;
        prepare(&p, n, at, F, old, parameters, floor, solved, kappa_dt, driver, repulsion);
        memcpy(global, start + 9 * at, sizeof(tensor));
        rotated(global, p.basis, 0, s.D);
        evaluate(&p, &s);
        for (int iteration = 0; iteration < ITERATIONS && !s.converged && p.driver != FINGER; ++iteration)
            iterate(&p, &s);
        rotated(s.D, p.basis, 1, global);
        memcpy(tensors + 9 * at, global, sizeof(tensor));
        rotated(s.A, p.basis, 1, global);
        memcpy(structure + 9 * at, global, sizeof(tensor));
        rotated(s.S, p.basis, 1, global);
        ALL(i) ALL(j) {
            P[i][j] = 0;
            ALL(k) P[i][j] += p.F[i][k] * global[k][j];
        }
        memcpy(stresses + 9 * at, P, sizeof(tensor));
        squared[at] = s.squared;
        converged[at] = s.converged;
    }
}

/* The end of local_problem.LocalProblem.tangent: dP/dF (9, 9) = dC/dF^T dS/dC dC/dF / 2, and S, with both in the
   eigenbasis of C. */
static void by_gradient(point *p, tensor S, matrix by_strain, double *result)
{
    double carried[3][3], strain[6][9], stress[6][9];   /* F Q, dC/dF, dS/dF */
    tensor outside;
    rotated(S, p->basis, 1, outside);
    ALL(i) ALL(j) {
        carried[i][j] = 0;
        ALL(k) carried[i][j] += p->F[i][k] * p->basis[k][j];
    }
    MANDEL(a) ALL(k) ALL(L) {
        const int i = ROW[a], j = COLUMN[a];
        strain[a][3 * k + L] = FACTOR[a] * (carried[k][i] * p->basis[L][j] + carried[k][j] * p->basis[L][i]);
    }
    memset(stress, 0, sizeof(stress));
    MANDEL(a) MANDEL(b) for (int c = 0; c < 9; ++c) stress[a][c] += by_strain[a][b] / 2 * strain[b][c];
    for (int r = 0; r < 9; ++r)
        for (int c = 0; c < 9; ++c) {
            double sum = r / 3 == c / 3 ? outside[r % 3][c % 3] : 0;
            MANDEL(a) sum += strain[a][r] * stress[a][c];
            result[9 * r + c] = sum;
        }
}

/* local_problem.LocalProblem.tangent at solved points. */
void tangent(int64_t n, const double *F, const double *tensors, const double *old, const double *parameters,
             double floor, double solved, const double *kappa_dt, int driver, int repulsion, double *result)
{
    for (int64_t at = 0; at < n; ++at) {
        point p;
        state s;
        tensor global;
        matrix left, through_cells, direct, right, change;
        prepare(&p, n, at, F, old, parameters, floor, solved, kappa_dt, driver, repulsion);
        memcpy(global, tensors + 9 * at, sizeof(tensor));
        rotated(global, p.basis, 0, s.D);
        evaluate(&p, &s);
        equation(&p, &s, left, through_cells, direct);
        drive_by_strain(&p, s.S, right);
        MANDEL(a) MANDEL(b) right[a][b] += by_stress(&p, ROW[a], COLUMN[a]) * direct[a][b];
        divide(left, &right[0][0], 6);
        product(through_cells, right, change);
        MANDEL(a) MANDEL(b) direct[a][b] += change[a][b];
        by_gradient(&p, s.S, direct, result + 81 * at);
    }
}
