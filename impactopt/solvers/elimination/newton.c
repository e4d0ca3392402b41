/* Kernels of condensed Newton systems: small dense algebra. The functions are those of class Kernels in kernels.py.

   Matrices are stored by columns, as in BLAS and LAPACK: an array (k, a, b) of NumPy is k matrices of b rows and a
   columns. Places of entries outside a pattern are 0, where the value is zero. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

typedef void gemm_t(char *, char *, int *, int *, int *, double *, double *, int *, double *, int *, double *,
                    double *, int *);
typedef void gemv_t(char *, int *, int *, double *, double *, int *, double *, int *, double *, double *, int *);
typedef void syrk_t(char *, char *, int *, int *, double *, double *, int *, double *, double *, int *);
typedef void trsm_t(char *, char *, char *, char *, int *, int *, double *, double *, int *, double *, int *);
typedef void getrf_t(int *, int *, double *, int *, int *, int *);
typedef void getrs_t(char *, int *, int *, double *, int *, int *, double *, int *, int *);
typedef void potrf_t(char *, int *, double *, int *, int *);

static gemm_t *gemm;
static gemv_t *gemv;
static syrk_t *syrk;
static trsm_t *trsm;
static getrf_t *getrf;
static getrs_t *getrs;
static potrf_t *potrf;
static double one = 1.0, minus = -1.0, zero = 0.0, half = 0.5;
static int unit = 1;

EXPORT void newton_setup(void **f) {
    gemm = (gemm_t *)f[0], gemv = (gemv_t *)f[1], syrk = (syrk_t *)f[2], trsm = (trsm_t *)f[3];
    getrf = (getrf_t *)f[4], getrs = (getrs_t *)f[5], potrf = (potrf_t *)f[6];
}

/* `length` consecutive places, from `place` on */
typedef struct {
    int32_t place, length;
} run;

/* Add n values to W, run by run; returns the run after them. */
static inline const run *scatter(const run *to, int n, const double *restrict numbers, double *restrict W) {
    for (int j = 0; j < n; j += to++->length) {
        double *places = W + to->place;
        for (int l = 0; l < to->length; ++l) places[l] += numbers[j + l];
    }
    return to;
}

/* Class EliminationStage: k systems of r equalities; nt other equalities, nc and nu variables that they touch. */
typedef struct {
    int64_t k, r, nt, nc, nu;
    int32_t *q, *e, *t, *u, *qe, *qc, *te, *tc, *hee, *heu;
    double *lu;
    int32_t *pivots;
    double *X, *T, *H, *G, *x0, *own, *work;
    const run *hcc, *hcv; /* runs of all systems: row by row of the lower triangle, and variable by variable */
} stage;

static void take(const double *from, const int32_t *at, int64_t count, double *to) {
    for (int64_t i = 0; i < count; ++i) to[i] = from[at[i]];
}

EXPORT void newton_copy(const double *values, const int32_t *source, double *to, const int32_t *places,
                        int64_t count) {
    for (int64_t i = 0; i < count; ++i) to[places[i]] = values[source[i]];
}

/* ---------------------------------------------------------------- matrices */
/* Add to sums (n) the first entries of up to four rows (m), each times its factor. */
static inline void add_rows(double *restrict sums, int n, int count, const double *f, const double *v, int m) {
    const double *v1 = v + m, *v2 = v1 + m, *v3 = v2 + m;
    if (count == 1)
        for (int j = 0; j < n; ++j) sums[j] += f[0] * v[j];
    else if (count == 2)
        for (int j = 0; j < n; ++j) sums[j] += f[0] * v[j] + f[1] * v1[j];
    else if (count == 3)
        for (int j = 0; j < n; ++j) sums[j] += f[0] * v[j] + f[1] * v1[j] + f[2] * v2[j];
    else
        for (int j = 0; j < n; ++j) sums[j] += f[0] * v[j] + f[1] * v1[j] + f[2] * v2[j] + f[3] * v3[j];
}

/* Class Products: groups of g rows with p columns; `to` has the runs of W's places, row by row of the lower triangle
   of the outer products. work: the rows of a group whose weight is not zero, these weights, and the sums of one row
   of products. */
EXPORT void newton_products(int64_t groups, const int32_t *g, const int32_t *p, const int32_t *rows,
                            const int32_t *values, const run *to, const double *J, const double *weights,
                            double *W, double *work) {
    for (int64_t k = 0; k < groups; ++k) {
        int m = p[k], live = 0;
        double *v = work, *weight = work + g[k] * m, *sums = weight + g[k];
        for (int row = 0; row < g[k]; ++row, values += m) {
            double w = weights[*rows++];
            if (w == 0.0) continue;
            take(J, values, m, v + live * m);
            weight[live++] = w;
        }
        for (int i = 0; i < m; ++i) {
            memset(sums, 0, sizeof(double) * (i + 1));
            for (int row = 0; row < live; row += 4) {
                int count = live - row < 4 ? live - row : 4;
                double f[4];
                for (int q = 0; q < count; ++q) f[q] = weight[row + q] * v[(row + q) * m + i];
                add_rows(sums, i + 1, count, f, v + row * m, m);
            }
            to = scatter(to, i + 1, sums, W);
        }
    }
}

/* Systems of so few equalities have loops of their own: a call of BLAS takes longer than such a product. */
#define FEW 8

/* Copy a matrix (r, n) that is stored by columns to one that is stored by rows. */
static void transpose(const double *columns, int r, int n, double *rows) {
    for (int i = 0; i < n; ++i)
        for (int p = 0; p < r; ++p) rows[p * n + i] = columns[i * r + p];
}

static void add(double *restrict to, double factor, const double *restrict from, int n) {
    for (int i = 0; i < n; ++i) to[i] += factor * from[i];
}

/* Replace rows (r, n) by B^-1 times them; lu, pivots: the factors of B from getrf. */
static void solve_few(const double *lu, const int32_t *pivots, int r, int n, double *rows) {
    for (int p = 0; p < r; ++p) {
        double *one_row = rows + p * n, *other = rows + (pivots[p] - 1) * n;
        if (one_row != other)
            for (int i = 0; i < n; ++i) {
                double swapped = one_row[i];
                one_row[i] = other[i], other[i] = swapped;
            }
    }
    for (int p = 0; p < r; ++p)
        for (int q = 0; q < p; ++q) add(rows + p * n, -lu[q * r + p], rows + q * n, n);
    for (int p = r - 1; p >= 0; --p) {
        for (int q = p + 1; q < r; ++q) add(rows + p * n, -lu[q * r + p], rows + q * n, n);
        double over = 1.0 / lu[p * r + p];
        for (int i = 0; i < n; ++i) rows[p * n + i] *= over;
    }
}

static int eliminate(stage *a, double *J) {
    int r = a->r, nc = a->nc, nt = a->nt, info;
    double *rows = a->work, *sums = a->work + r * nc;
    for (int64_t k = 0; k < a->k; ++k) {
        double *lu = a->lu + k * r * r, *X = a->X + k * nc * r, *T = a->T + k * nt * r;
        int32_t *pivots = a->pivots + k * r;
        const int32_t *to = a->tc + k * nt * nc;
        take(J, a->qe + k * r * r, r * r, lu);
        take(J, a->qc + k * nc * r, nc * r, X);
        take(J, a->te + k * nt * r, nt * r, T);
        getrf(&r, &r, lu, &r, pivots, &info);
        if (info) return info;
        if (!nc) continue;
        if (r > FEW) {
            getrs("N", &r, &nc, lu, &r, pivots, X, &r, &info);
            if (nt) gemm("T", "N", &nc, &nt, &r, &one, X, &r, T, &r, &zero, a->work, &nc);
            for (int64_t i = 0; i < nt * nc; ++i) J[to[i]] -= a->work[i];
        } else {
            transpose(X, r, nc, rows);
            solve_few(lu, pivots, r, nc, rows);
            transpose(rows, nc, r, X);
            for (int t = 0; t < nt; ++t) {
                memset(sums, 0, sizeof(double) * nc);
                for (int p = 0; p < r; ++p) add(sums, T[t * r + p], rows + p * nc, nc);
                for (int i = 0; i < nc; ++i) J[*to++] -= sums[i];
            }
        }
    }
    return 0;
}

/* Where the runs of the next system begin. */
typedef struct {
    const run *cc, *cv;
} targets;

/* W += C + C' for the variables c, which are in the equalities, W += C for the others; C = X' G. */
static targets spread(const stage *a, targets to, double *X, double *G, double *C, double *W) {
    int r = a->r, nc = a->nc, nv = a->nu - nc;
    gemm("T", "N", &nc, &nc, &r, &one, G, &r, X, &r, &zero, C, &nc);
    double *sums = C + nc * nc;
    for (int i = 0; i < nc; ++i) {
        for (int j = 0; j <= i; ++j) sums[j] = C[i * nc + j] + C[j * nc + i];
        to.cc = scatter(to.cc, i + 1, sums, W);
    }
    if (!nv) return to;
    gemm("T", "N", &nc, &nv, &r, &one, X, &r, G + nc * r, &r, &zero, C, &nc);
    for (int v = 0; v < nv; ++v) to.cv = scatter(to.cv, nc, C + v * nc, W);
    return to;
}

/* The same for few equalities, with X (r, nc) and G (r, nu) stored by rows. */
static inline __attribute__((always_inline)) targets spread_rows(const stage *a, targets to, int r,
                                                                 const double *restrict X, const double *restrict G,
                                                                 double *restrict sums, double *restrict W) {
    int nc = a->nc, nu = a->nu;
    for (int i = 0; i < nc; ++i) {
        double x[FEW], g[FEW];
        for (int p = 0; p < r; ++p) x[p] = X[p * nc + i], g[p] = G[p * nu + i];
        for (int j = 0; j <= i; ++j) {
            double sum = 0.0;
            for (int p = 0; p < r; ++p) sum += x[p] * G[p * nu + j] + g[p] * X[p * nc + j];
            sums[j] = sum;
        }
        to.cc = scatter(to.cc, i + 1, sums, W);
    }
    for (int v = nc; v < nu; ++v) {
        double g[FEW];
        for (int p = 0; p < r; ++p) g[p] = G[p * nu + v];
        for (int j = 0; j < nc; ++j) {
            double sum = 0.0;
            for (int p = 0; p < r; ++p) sum += g[p] * X[p * nc + j];
            sums[j] = sum;
        }
        to.cv = scatter(to.cv, nc, sums, W);
    }
    return to;
}

static targets spread_few(const stage *a, targets to, const double *X, const double *G, double *sums, double *W) {
    if (a->r == 6) /* a leg, a wrench: the compiler unrolls loops of a constant length */
        return spread_rows(a, to, 6, X, G, sums, W);
    return spread_rows(a, to, a->r, X, G, sums, W);
}

static void reduce(stage *a, double *W) {
    int r = a->r, nc = a->nc, nu = a->nu;
    double *G = a->work, *more = G + r * nu, *sums = more + r * nc;
    targets to = {a->hcc, a->hcv};
    for (int64_t k = 0; k < a->k; ++k) {
        double *X = a->X + k * nc * r, *H = a->H + k * r * r, *own = a->G + k * nu * r;
        take(W, a->hee + k * r * r, r * r, H);
        take(W, a->heu + k * nu * r, nu * r, own);
        if (!nc) continue;
        if (r > FEW) {
            for (int64_t i = 0; i < nu * r; ++i) G[i] = -own[i];
            gemm("N", "N", &r, &nc, &r, &half, H, &r, X, &r, &one, G, &r);
            to = spread(a, to, X, G, more, W);
        } else {
            transpose(X, r, nc, more);
            transpose(own, r, nu, G);
            for (int i = 0; i < r * nu; ++i) G[i] = -G[i];
            for (int p = 0; p < r; ++p)
                for (int q = 0; q < r; ++q) add(G + p * nu, 0.5 * H[q * r + p], more + q * nc, nc);
            to = spread_few(a, to, more, G, sums, W);
        }
    }
}

/* ---------------------------------------------------------------- vectors */
/* to[at] -= M' v for a matrix of r rows and n columns. */
static void subtract_transposed(int r, int n, double *M, double *v, double *to, const int32_t *at, double *work) {
    if (!n) return;
    gemv("T", &r, &n, &one, M, &r, v, &unit, &zero, work, &unit);
    for (int i = 0; i < n; ++i) to[at[i]] -= work[i];
}

static void forward(stage *a, double *g, double *off) {
    int r = a->r, nc = a->nc, nt = a->nt, nu = a->nu, info;
    double *own = a->work, *work = own + r;
    for (int64_t k = 0; k < a->k; ++k) {
        double *x0 = a->x0 + k * r, *X = a->X + k * nc * r;
        const int32_t *u = a->u + k * nu;
        take(off, a->q + k * r, r, x0);
        getrs("N", &r, &unit, a->lu + k * r * r, &r, a->pivots + k * r, x0, &r, &info);
        subtract_transposed(r, nt, a->T + k * nt * r, x0, off, a->t + k * nt, work);
        take(g, a->e + k * r, r, own);
        gemv("N", &r, &r, &minus, a->H + k * r * r, &r, x0, &unit, &one, own, &unit);
        subtract_transposed(r, nc, X, own, g, u, work);
        subtract_transposed(r, nu, a->G + k * nu * r, x0, g, u, work);
    }
}

static void expand(stage *a, double *d) {
    int r = a->r, nc = a->nc;
    double *own = a->work, *others = own + r;
    for (int64_t k = 0; k < a->k; ++k) {
        memcpy(own, a->x0 + k * r, sizeof(double) * r);
        take(d, a->u + k * a->nu, nc, others);
        if (nc) gemv("N", &r, &nc, &one, a->X + k * nc * r, &r, others, &unit, &one, own, &unit);
        for (int i = 0; i < r; ++i) d[a->e[k * r + i]] = -own[i];
    }
}

/* Multipliers, first pass: the part of the gradient v by the eliminated variables. */
static void own_duals(stage *a, double *v) {
    int r = a->r, nc = a->nc;
    double *own = a->own;
    for (int64_t k = 0; k < a->k; ++k, own += r) {
        take(v, a->e + k * r, r, own);
        subtract_transposed(r, nc, a->X + k * nc * r, own, v, a->u + k * a->nu, a->work);
    }
}

/* Multipliers, second pass, last stage first: B^-T of that part and of the other equalities' multipliers. */
static void duals(stage *a, double *y) {
    int r = a->r, nt = a->nt, info;
    double *sum = a->work, *others = sum + r;
    for (int64_t k = 0; k < a->k; ++k) {
        memcpy(sum, a->own + k * r, sizeof(double) * r);
        take(y, a->t + k * nt, nt, others);
        if (nt) gemv("N", &r, &nt, &one, a->T + k * nt * r, &r, others, &unit, &one, sum, &unit);
        getrs("T", &r, &unit, a->lu + k * r * r, &r, a->pivots + k * r, sum, &r, &info);
        for (int i = 0; i < r; ++i) y[a->q[k * r + i]] = -sum[i];
    }
}

/* ---------------------------------------------------------------- entry points: all stages in turn */
EXPORT int newton_eliminate(stage *a, int64_t stages, double *J) {
    int info = 0;
    for (int64_t i = 0; i < stages && !info; ++i) info = eliminate(a + i, J);
    return info;
}

EXPORT void newton_reduce(stage *a, int64_t stages, double *W) {
    for (int64_t i = 0; i < stages; ++i) reduce(a + i, W);
}

EXPORT void newton_forward(stage *a, int64_t stages, double *g, double *off) {
    for (int64_t i = 0; i < stages; ++i) forward(a + i, g, off);
}

EXPORT void newton_expand(stage *a, int64_t stages, double *d) {
    for (int64_t i = stages - 1; i >= 0; --i) expand(a + i, d);
}

EXPORT void newton_multipliers(stage *a, int64_t stages, double *v, double *y) {
    for (int64_t i = 0; i < stages; ++i) own_duals(a + i, v);
    for (int64_t i = stages - 1; i >= 0; --i) duals(a + i, y);
}

/* ---------------------------------------------------------------- Cholesky factor of the condensed matrix */
/* Class Panels: `size` of each block, `height` of its panel, `at` which place its values begin; `below` lists the
   blocks of rows under each diagonal block, from `first` on; row_at (count, count): row of a panel at which a block
   begins. */
typedef struct {
    int64_t count;
    const int32_t *size, *height, *first, *below, *row_at, *start;
    const int64_t *at;
    double *work;
} panels;

EXPORT int newton_cholesky(panels *p, double *values) {
    int info;
    for (int64_t k = 0; k < p->count; ++k) {
        int own = p->size[k], h = p->height[k], rest = h - own;
        double *panel = values + p->at[k], *under = panel + own;
        potrf("L", &own, panel, &h, &info);
        if (info) return info;
        if (!rest) continue;
        trsm("R", "L", "T", "N", &rest, &own, &one, panel, &h, under, &h);
        syrk("L", "N", &rest, &own, &one, under, &h, &zero, p->work, &rest);
        int32_t from = p->first[k], to = p->first[k + 1];
        for (int32_t j = from; j < to; ++j) {
            int column = p->below[j], left = p->row_at[column * p->count + k] - own;
            for (int32_t i = j; i < to; ++i) {
                int row = p->below[i], top = p->row_at[row * p->count + k] - own;
                double *target = values + p->at[column] + p->row_at[row * p->count + column];
                const double *source = p->work + (int64_t)left * rest + top;
                for (int c = 0; c < p->size[column]; ++c)
                    for (int l = 0; l < p->size[row]; ++l)
                        target[(int64_t)c * p->height[column] + l] -= source[(int64_t)c * rest + l];
            }
        }
    }
    return 0;
}

/* Replace x (n, nrhs) by K^-1 x, for nrhs <= n: p->work has room for so many columns. */
static void solve(panels *p, double *values, double *x, int64_t n, int nrhs) {
    int nx = n;
    for (int64_t k = 0; k < p->count; ++k) {
        int own = p->size[k], h = p->height[k], rest = h - own;
        double *panel = values + p->at[k], *mine = x + p->start[k];
        trsm("L", "L", "N", "N", &own, &nrhs, &one, panel, &h, mine, &nx);
        if (!rest) continue;
        gemm("N", "N", &rest, &nrhs, &own, &one, panel + own, &h, mine, &nx, &zero, p->work, &rest);
        for (int32_t i = p->first[k], top = 0; i < p->first[k + 1]; top += p->size[p->below[i++]])
            for (int c = 0; c < nrhs; ++c)
                for (int l = 0; l < p->size[p->below[i]]; ++l)
                    x[c * n + p->start[p->below[i]] + l] -= p->work[(int64_t)c * rest + top + l];
    }
    for (int64_t k = p->count - 1; k >= 0; --k) {
        int own = p->size[k], h = p->height[k], rest = h - own;
        double *panel = values + p->at[k], *mine = x + p->start[k];
        if (rest) {
            for (int32_t i = p->first[k], top = 0; i < p->first[k + 1]; top += p->size[p->below[i++]])
                for (int c = 0; c < nrhs; ++c)
                    for (int l = 0; l < p->size[p->below[i]]; ++l)
                        p->work[(int64_t)c * rest + top + l] = x[c * n + p->start[p->below[i]] + l];
            gemm("T", "N", &own, &nrhs, &rest, &minus, panel + own, &h, p->work, &rest, &one, mine, &nx);
        }
        trsm("L", "L", "T", "N", &own, &nrhs, &one, panel, &h, mine, &nx);
    }
}

/* The same for any number of columns: there may be more of them than variables, if equalities depend on each other. */
EXPORT void newton_solve(panels *p, double *values, double *x, int64_t n, int64_t columns) {
    for (int64_t first = 0, count; n && first < columns; first += count) {
        count = columns - first < n ? columns - first : n;
        solve(p, values, x + first * n, n, count);
    }
}
