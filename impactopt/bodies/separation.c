/* Signed distances of convex bodies by rounded support functions. Theory: bodies/separation.py. The same without a
 * compiler: bodies/separation_numpy.py. */
#include <math.h>
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))
#define MAX_JOINTS 64
/* [rad] last step of a search for the separating direction: where only the distance is wanted, and with derivatives. A
 * direction that is wrong by d makes the distance wrong by some 0.2 m d^2. */
#define DISTANCES 1e-3
#define DERIVATIVES 1e-7
#define MAX_EXPONENT 36.0 /* exp(-36) = 2e-16: vertices with larger exponents do not count */

/* Rounded support in one direction; mean and covariance of the vertices, weighted by their share of it. */
typedef struct { double h, mean[3], cov[6]; } Support;

/* Vertices are stored in blocks of EIGHT: eight x, eight y, eight z. The last block is padded with copies.
 * Compilers do not vectorize loops over a block by themselves, as maxima and branches are in them: so a block's numbers
 * are vectors (an extension of gcc and clang) of the machine's width. Wider ones are split into single numbers where they
 * are compared. */
#define EIGHT 8
#define BLOCK (3 * EIGHT)
#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
typedef double Vector __attribute__((vector_size(8 * LANES), aligned(8), may_alias));
typedef int64_t Bits __attribute__((vector_size(8 * LANES), aligned(8), may_alias)); /* of a comparison: -1 or 0 each */
#define AT(p) (*(const Vector *)(p))
/* x of vertex i, where a vector of vertices begins; its y and z are EIGHT and 2 EIGHT further */
#define VERTEX(p, i) ((p) + (i) / EIGHT * BLOCK + (i) % EIGHT)

static inline Vector larger(Vector a, Vector b) {
    const Bits first = a > b;
    return (Vector)(((Bits)a & first) | ((Bits)b & ~first));
}
static inline double sum(Vector v) {
    double all = v[0];
    for (int j = 1; j < LANES; ++j) all += v[j];
    return all;
}
static inline int any(Bits b) {
    int64_t all = b[0];
    for (int j = 1; j < LANES; ++j) all |= b[j];
    return all != 0;
}

/* Heights of n vertices in direction u, written to far; returns the largest. */
static inline double support_heights(int64_t n, const double *restrict p, const double *u, double *restrict far) {
    Vector most = (Vector){0} - INFINITY;
    for (int64_t i = 0; i < n; i += LANES) {
        const double *q = VERTEX(p, i);
        const Vector f = AT(q) * u[0] + AT(q + EIGHT) * u[1] + AT(q + 2 * EIGHT) * u[2];
        *(Vector *)(far + i) = f;
        most = larger(f, most);
    }
    double top = most[0];
    for (int j = 1; j < LANES; ++j) top = most[j] > top ? most[j] : top;
    return top;
}

/* exp(x) for x <= 0 within 2 ulp: x = n log 2 + r, Taylor's polynomial in r, and n added to the exponent's bits. Adding
 * 1.5 * 2^52 rounds to the integer n. */
static inline Vector decay(Vector x) {
    const double whole = 0x1.8p52;
    const Vector c = larger(x, (Vector){0} - 700.0), shifted = c * 0x1.71547652b82fep0 + whole, n = shifted - whole;
    const Vector r = (c - n * 0x1.62e42fefa39efp-1) - n * 0x1.abc9e3b39803fp-56;
    /* 1 / k!, summed by pairs (Estrin), as one multiplication after the other would wait for each */
    const Vector r2 = r * r, r4 = r2 * r2, low = (r + 1.0) + (r * 0x1.5555555555555p-3 + 0.5) * r2;
    const Vector mid = (r * 0x1.1111111111111p-7 + 0x1.5555555555555p-5) + (r * 0x1.a01a01a01a01ap-13 + 0x1.6c16c16c16c17p-10) * r2;
    const Vector high = (r * 0x1.71de3a556c734p-19 + 0x1.a01a01a01a01ap-16) + (r * 0x1.ae64567f544e4p-26 + 0x1.27e4fb7789f5cp-22) * r2;
    const Vector e = low + (mid + high * r4) * r4;
    return e * (Vector)(((Bits)shifted + 1023) << 52);
}

/* Support of n vertices in direction u.  sharp [1/m]: 1 / rounding. */
static void support(int64_t n, const double *restrict p, const double *u, double sharp, double *restrict far,
                    Support *out) {
    const double most = support_heights(n, p, u, far), least = most - MAX_EXPONENT / sharp;
    const double ox = p[0], oy = p[EIGHT], oz = p[2 * EIGHT]; /* any vertex: moments about a distant point cancel */
    Vector s[10] = {{0}};
    for (int64_t i = n; i % LANES; ++i) far[i] = -1e300; /* copies do not count */
    for (int64_t i = 0; i < n; i += LANES) {
        const Vector height = AT(far + i);
        if (!any(height >= least)) continue;
        const double *q = VERTEX(p, i);
        const Vector e = decay(sharp * (height - most));
        const Vector x = AT(q) - ox, y = AT(q + EIGHT) - oy, z = AT(q + 2 * EIGHT) - oz, ex = e * x, ey = e * y, ez = e * z;
        s[0] += e; s[1] += ex; s[2] += ey; s[3] += ez;
        s[4] += ex * x; s[5] += ex * y; s[6] += ex * z;
        s[7] += ey * y; s[8] += ey * z; s[9] += ez * z;
    }
    const double total = sum(s[0]), one = 1.0 / total, m0 = sum(s[1]) * one, m1 = sum(s[2]) * one, m2 = sum(s[3]) * one;
    out->h = most + log(total) / sharp;
    out->mean[0] = ox + m0; out->mean[1] = oy + m1; out->mean[2] = oz + m2;
    out->cov[0] = sum(s[4]) * one - m0 * m0; out->cov[1] = sum(s[5]) * one - m0 * m1; out->cov[2] = sum(s[6]) * one - m0 * m2;
    out->cov[3] = sum(s[7]) * one - m1 * m1; out->cov[4] = sum(s[8]) * one - m1 * m2; out->cov[5] = sum(s[9]) * one - m2 * m2;
}

static inline double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
static inline void cross(const double *a, const double *b, double *c) {
    c[0] = a[1] * b[2] - a[2] * b[1]; c[1] = a[2] * b[0] - a[0] * b[2]; c[2] = a[0] * b[1] - a[1] * b[0];
}
static inline void times(const double *R, const double *x, double *y) {
    for (int i = 0; i < 3; ++i) y[i] = R[3 * i] * x[0] + R[3 * i + 1] * x[1] + R[3 * i + 2] * x[2];
}
static inline void times_t(const double *R, const double *x, double *y) {
    for (int i = 0; i < 3; ++i) y[i] = R[i] * x[0] + R[3 + i] * x[1] + R[6 + i] * x[2];
}
static inline void symmetric(const double *c, const double *x, double *y) {
    y[0] = c[0] * x[0] + c[1] * x[1] + c[2] * x[2];
    y[1] = c[1] * x[0] + c[3] * x[1] + c[4] * x[2];
    y[2] = c[2] * x[0] + c[4] * x[1] + c[5] * x[2];
}

/* Separation of two bodies along a direction u from the second to the first, in the second's frame. */
typedef struct {
    double s, w[3], point[3], cov_one[6], cov[6]; /* separation, its gradient by u, support point of the first, covariances */
    double basis[6], neg_hessian[3], slope[2];           /* tangents of the sphere at u; minus Hessian (xx, xy, yy) and gradient on them */
    double u[3];
} Side; /* SIDE numbers */

static void side(const double *R, const double *t, int64_t n1, const double *p1, int64_t n2, const double *p2,
                 const double *u, double sharp, double *far, Side *out) {
    Support a, b;
    double down[3] = {-u[0], -u[1], -u[2]}, local[3], first[3], half[9];
    times_t(R, down, local);
    support(n1, p1, local, sharp, far, &a);
    support(n2, p2, u, sharp, far, &b);
    times(R, a.mean, first);
    for (int i = 0; i < 3; ++i) out->point[i] = first[i] + t[i];
    out->s = dot(u, t) - a.h - b.h;
    for (int i = 0; i < 3; ++i) out->w[i] = out->point[i] - b.mean[i];
    /* R cov R' */
    const double full[9] = {a.cov[0], a.cov[1], a.cov[2], a.cov[1], a.cov[3], a.cov[4], a.cov[2], a.cov[4], a.cov[5]};
    for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j)
        half[3 * i + j] = R[3 * i] * full[j] + R[3 * i + 1] * full[3 + j] + R[3 * i + 2] * full[6 + j];
    int k = 0;
    for (int i = 0; i < 3; ++i) for (int j = i; j < 3; ++j, ++k) {
        out->cov_one[k] = half[3 * i] * R[3 * j] + half[3 * i + 1] * R[3 * j + 1] + half[3 * i + 2] * R[3 * j + 2];
        out->cov[k] = out->cov_one[k] + b.cov[k];
    }
    double *x = out->basis, *y = out->basis + 3, turned[3];
    int least = fabs(u[0]) < fabs(u[1]) ? (fabs(u[0]) < fabs(u[2]) ? 0 : 2) : (fabs(u[1]) < fabs(u[2]) ? 1 : 2);
    double e[3] = {0, 0, 0}; e[least] = 1.0;
    cross(u, e, x);
    double length = sqrt(dot(x, x));
    for (int i = 0; i < 3; ++i) x[i] /= length;
    cross(u, x, y);
    const double along = dot(u, out->w);
    symmetric(out->cov, x, turned);
    out->neg_hessian[0] = sharp * dot(turned, x) + along; out->neg_hessian[1] = sharp * dot(turned, y);
    symmetric(out->cov, y, turned);
    out->neg_hessian[2] = sharp * dot(turned, y) + along;
    out->slope[0] = dot(x, out->w); out->slope[1] = dot(y, out->w);
}

/* Inverse (xx, xy, yy) of minus the Hessian, shifted so that its least eigenvalue is at least `floor`. */
static void inverse(const double *neg_hessian, double floor, double *out) {
    double mean = 0.5 * (neg_hessian[0] + neg_hessian[2]), diff = 0.5 * (neg_hessian[0] - neg_hessian[2]);
    double radius = sqrt(diff * diff + neg_hessian[1] * neg_hessian[1]), low = mean - radius, more = low < floor ? floor - low : 0.0;
    double a = neg_hessian[0] + more, c = neg_hessian[2] + more, b = neg_hessian[1], d = a * c - b * b;
    out[0] = c / d; out[1] = -b / d; out[2] = a / d;
}

/* Step off a stationary direction that is no maximum, which occurs if bodies penetrate: along the direction of
 * positive curvature. Returns 0 at a maximum. */
static int leave_saddle(const Side *at, double *step) {
    double mean = 0.5 * (at->neg_hessian[0] + at->neg_hessian[2]), diff = 0.5 * (at->neg_hessian[0] - at->neg_hessian[2]);
    double radius = sqrt(diff * diff + at->neg_hessian[1] * at->neg_hessian[1]), low = mean - radius;
    if (low > -1e-9) return 0;
    double a = at->neg_hessian[1], b = low - at->neg_hessian[0];
    if (fabs(a) + fabs(b) < 1e-14) { a = 1.0; b = 0.0; }
    double length = sqrt(a * a + b * b), way = a * at->slope[0] + b * at->slope[1] < 0.0 ? -0.1 : 0.1;
    step[0] = way * a / length; step[1] = way * b / length;
    return 1;
}

/* Local maximum of the separation over directions, from u (3) on, which moves there: Newton's method on the sphere.
 * It ends after a step of less than `last` radians: convergence is quadratic, and the separation's error is of second
 * order in that of u. */
static void separate(const double *R, const double *t, int64_t n1, const double *p1, int64_t n2, const double *p2,
                    double *u, double sharp, double last, double *far, Side *at) {
    side(R, t, n1, p1, n2, p2, u, sharp, far, at);
    for (int taken = 0; taken < 100; ++taken) {
        double inv[3], step[2], next[3];
        inverse(at->neg_hessian, 1e-4, inv);
        step[0] = inv[0] * at->slope[0] + inv[1] * at->slope[1];
        step[1] = inv[1] * at->slope[0] + inv[2] * at->slope[1];
        double size = sqrt(step[0] * step[0] + step[1] * step[1]), gain = step[0] * at->slope[0] + step[1] * at->slope[1];
        if (size < 1e-2 * last && leave_saddle(at, step)) { size = 0.1; gain = 0.0; }
        if (size < 1e-4 * last) break;
        double part = size > 0.5 ? 0.5 / size : 1.0;
        Side found;
        int moved = 0;
        for (int tries = 0; tries < 30; ++tries, part *= 0.4) {
            for (int i = 0; i < 3; ++i) next[i] = u[i] + part * (at->basis[i] * step[0] + at->basis[3 + i] * step[1]);
            double length = sqrt(dot(next, next));
            for (int i = 0; i < 3; ++i) next[i] /= length;
            side(R, t, n1, p1, n2, p2, next, sharp, far, &found);
            if (found.s >= at->s + 1e-4 * part * gain || size < 1e-5) { moved = 1; break; }
        }
        if (!moved) break;
        for (int i = 0; i < 3; ++i) u[i] = next[i];
        *at = found;
        if (part * size < last && !leave_saddle(at, step)) break;
    }
}

/* Forward kinematics of a chain: rotation R (9) and translation t (3) of its end; axes and origins (n, 3) of its joints. */
static void chain(int64_t n, const double *z, const double *p, double *R, double *t, double *axis, double *origin) {
    const double *turns = p + 12 * (n + 1);
    for (int i = 0; i < 9; ++i) R[i] = p[i];
    for (int i = 0; i < 3; ++i) t[i] = p[9 + i] + z[i];
    for (int64_t k = 0; k < n; ++k) {
        const double *next = p + 12 * (k + 1), q = z[3 + k];
        double turned[9], shift[3];
        for (int i = 0; i < 3; ++i) { axis[3 * k + i] = R[3 * i + 2]; origin[3 * k + i] = t[i]; }
        if (turns[k] > 0.5) {
            double c = cos(q), s = sin(q);
            for (int i = 0; i < 3; ++i) {
                double a = R[3 * i], b = R[3 * i + 1];
                R[3 * i] = c * a + s * b; R[3 * i + 1] = c * b - s * a;
            }
        } else for (int i = 0; i < 3; ++i) t[i] += q * R[3 * i + 2];
        times(R, next + 9, shift);
        for (int i = 0; i < 3; ++i) t[i] += shift[i];
        for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j)
            turned[3 * i + j] = R[3 * i] * next[j] + R[3 * i + 1] * next[3 + j] + R[3 * i + 2] * next[6 + j];
        for (int i = 0; i < 9; ++i) R[i] = turned[i];
    }
}

/* Direction way (3) to begin the search at: u, turned by what the last derivatives foresee for z. */
static void predicted(int64_t size, const double *z, const double *rate, const double *u, double *way) {
    double turn[3] = {0, 0, 0};
    for (int64_t k = 0; k < size; ++k)
        for (int i = 0; i < 3; ++i) turn[i] += rate[size + 3 * k + i] * (z[k] - rate[k]);
    const double length = sqrt(dot(turn, turn)), part = length > 0.3 ? 0.3 / length : 1.0;
    for (int i = 0; i < 3; ++i) way[i] = u[i] + part * turn[i];
    const double norm = 1.0 / sqrt(dot(way, way));
    for (int i = 0; i < 3; ++i) way[i] *= norm;
}

/* Separation minus required distance of `count` pairs, each along a chain of n joints.
 * z (count, n + 3): base translation, joint angles.  p (count, 13 n + 13): chain, required distance.
 * hulls (count, 4): first vertex and number of vertices of both bodies; first vertices are multiples of EIGHT.
 * points: vertices in blocks.  u (count, 3): initial directions, updated if derivatives are requested.
 * known (count, SIDE), seen (count, n + 3): last results, and the z that they belong to.
 * turn (count, 4 (n + 3)): z at the last Hessians, and the derivatives of u by it (n + 3, 3); zeros before.
 * far: work memory for the largest hull.
 * what: 0 values (count,); 1 gradients (count, n + 3); 2 lam times Hessians, lower triangles by columns. */
EXPORT void separation(int64_t count, int64_t n, const double *z, const double *p, const int64_t *hulls,
                          const double *points, double sharp, double *u, double *known, double *seen, double *turn,
                          double *far, int64_t what, const double *lam, double *out) {
    const int64_t size = n + 3, width = 13 * n + 13;
    for (int64_t row = 0; row < count; ++row) {
        double R[9], t[3], axis[3 * MAX_JOINTS], origin[3 * MAX_JOINTS];
        const double *mine = p + row * width, *turns = mine + 12 * (n + 1);
        const int64_t *h = hulls + 4 * row;
        double way[3], *last = seen + row * size;
        Side *kept = (Side *)known + row, at;
        int same = 1;
        for (int64_t i = 0; i < size; ++i) same &= last[i] == z[row * size + i];
        if (!same || what) chain(n, z + row * size, mine, R, t, axis, origin);
        if (!same) {
            predicted(size, z + row * size, turn + 4 * row * size, u + 3 * row, way);
            separate(R, t, h[1], points + 3 * h[0], h[3], points + 3 * h[2], way, sharp, DERIVATIVES, far, &at);
            for (int i = 0; i < 3; ++i) at.u[i] = way[i];
            *kept = at;
            for (int64_t i = 0; i < size; ++i) last[i] = z[row * size + i];
        } else {
            at = *kept;
            for (int i = 0; i < 3; ++i) way[i] = at.u[i];
        }
        if (what) for (int i = 0; i < 3; ++i) u[3 * row + i] = way[i];
        if (what == 0) { out[row] = at.s - mine[13 * n + 12]; continue; }
        double arm[3 * MAX_JOINTS];
        for (int64_t k = 0; k < n; ++k) {
            double from[3] = {at.point[0] - origin[3 * k], at.point[1] - origin[3 * k + 1], at.point[2] - origin[3 * k + 2]};
            if (turns[k] > 0.5) cross(axis + 3 * k, from, arm + 3 * k);
            else for (int i = 0; i < 3; ++i) arm[3 * k + i] = axis[3 * k + i];
        }
        if (what == 1) {
            double *g = out + row * size;
            for (int i = 0; i < 3; ++i) g[i] = way[i];
            for (int64_t k = 0; k < n; ++k) g[3 + k] = dot(way, arm + 3 * k);
            continue;
        }
        const double by = lam[row];
        double *H = out + row * size * (size + 1) / 2;
        /* mixed (2,): derivative of the gradient on the tangents by each variable; f = u x axis, C f */
        double f[3 * MAX_JOINTS], Cf[3 * MAX_JOINTS], mixed[2 * (MAX_JOINTS + 3)], spread[2 * (MAX_JOINTS + 3)], inv[3];
        inverse(at.neg_hessian, 1e-4, inv);
        for (int i = 0; i < 3; ++i) { mixed[2 * i] = at.basis[i]; mixed[2 * i + 1] = at.basis[3 + i]; }
        for (int64_t k = 0; k < n; ++k) {
            double m[3];
            if (turns[k] > 0.5) { cross(way, axis + 3 * k, f + 3 * k); symmetric(at.cov_one, f + 3 * k, Cf + 3 * k); }
            else for (int i = 0; i < 3; ++i) f[3 * k + i] = Cf[3 * k + i] = 0.0;
            for (int i = 0; i < 3; ++i) m[i] = arm[3 * k + i] - sharp * Cf[3 * k + i];
            mixed[2 * (3 + k)] = dot(at.basis, m); mixed[2 * (3 + k) + 1] = dot(at.basis + 3, m);
        }
        for (int64_t k = 0; k < size; ++k) {
            spread[2 * k] = inv[0] * mixed[2 * k] + inv[1] * mixed[2 * k + 1];
            spread[2 * k + 1] = inv[1] * mixed[2 * k] + inv[2] * mixed[2 * k + 1];
        }
        /* for `predicted`: z, and how u turns with it */
        double *rate = turn + 4 * row * size;
        for (int64_t k = 0; k < size; ++k) {
            rate[k] = z[row * size + k];
            for (int i = 0; i < 3; ++i) rate[size + 3 * k + i] = at.basis[i] * spread[2 * k] + at.basis[3 + i] * spread[2 * k + 1];
        }
        if (by == 0.0) { for (int64_t i = 0; i < size * (size + 1) / 2; ++i) H[i] = 0.0; continue; }
        for (int64_t i = 0; i < size; ++i) for (int64_t k = i; k < size; ++k) {
            double v = spread[2 * i] * mixed[2 * k] + spread[2 * i + 1] * mixed[2 * k + 1];
            if (i >= 3) /* u . (axis_i x arm_k) - sharp f_i C f_k */
                v += dot(f + 3 * (i - 3), arm + 3 * (k - 3)) - sharp * dot(f + 3 * (i - 3), Cf + 3 * (k - 3));
            *H++ = by * v;
        }
    }
}

/* ---- search for near pairs. Placements of joints (K, J, 12) and of the world's bodies (K, W, 12): rotation by rows,
 * translation.  B pieces of links: of (B,) joints, balls (B, 4) centre and radius in the joint's frame.  boxes (W, 4):
 * half sides and inflation of the world's bodies.  pairs (P, 2): joint, and joint or -1 - the world's body.
 * pieces (P, 2): the same pairs by pieces.  hulls (P, 4).  extra (P,): inflation of the second body.  present (K, W).
 * directions (K, P, 3): updated; zero if unknown.  gaps (K, P): separations, or lower bounds of those that are not
 * below `within` (K, P).  joints0, world0, gaps0: other placements and their gaps, or null: a gap is no less than there
 * minus the ways of both bodies.  room: work memory for the heights of the largest hull, and (4 B + J) numbers.
 * Returns the number of pairs below `within`; their indices are in near (2 each), at most `most`. */
/* Placement of a in b's frame. */
static void relative(const double *a, const double *b, double *R) {
    double d[3] = {a[9] - b[9], a[10] - b[10], a[11] - b[11]};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) R[3 * i + j] = b[i] * a[j] + b[3 + i] * a[3 + j] + b[6 + i] * a[6 + j];
        R[9 + i] = b[i] * d[0] + b[3 + i] * d[1] + b[6 + i] * d[2];
    }
}
/* Distance of a point from a box (half sides) at a placement, negative inside; way (3): from its surface, in its frame. */
static double from_box(const double *point, const double *box, const double *half, double *way) {
    double rel[3], x[3], deepest = -1e300, sum = 0.0;
    for (int j = 0; j < 3; ++j) rel[j] = point[j] - box[9 + j];
    times_t(box, rel, x);
    for (int j = 0; j < 3; ++j) {
        const double d = fabs(x[j]) - half[j], out = d > 0 ? d : 0.0;
        deepest = d > deepest ? d : deepest;
        way[j] = x[j] > 0 ? out : -out; sum += out * out;
    }
    if (sum > 0) return sqrt(sum);
    for (int j = 0; j < 3; ++j) way[j] = fabs(x[j]) - half[j] == deepest ? (x[j] > 0 ? 1.0 : -1.0) : 0.0;
    return deepest;
}
static void centre_of(const double *place, const double *ball, double *c) {
    times(place, ball, c);
    for (int j = 0; j < 3; ++j) c[j] += place[9 + j];
}
static double angle_between(const double *R0, const double *R1) {
    double trace = 0.0;
    for (int j = 0; j < 9; ++j) trace += R0[j] * R1[j];
    return acos(fmax(-1.0, fmin(1.0, 0.5 * (trace - 1.0))));
}
static double length_between(const double *a, const double *b) {
    const double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    return sqrt(dot(d, d));
}
/* Largest way of any point of a ball, placed at a0 and at a1, relative to a body that is placed at b0 and at b1. */
static double relative_way(const double *a0, const double *b0, const double *a1, const double *b1, const double *ball) {
    double R0[12], R1[12], x0[3], x1[3];
    relative(a0, b0, R0); relative(a1, b1, R1);
    centre_of(R0, ball, x0); centre_of(R1, ball, x1);
    return length_between(x0, x1) + angle_between(R0, R1) * ball[3];
}
/* Largest way (B,) of any point of the pieces' balls between placements of the joints (J, 12).  turned: memory (J,). */
static void motions(int64_t J, int64_t B, const double *from, const double *to, const int64_t *of, const double *balls,
                    double *turned, double *moved) {
    for (int64_t j = 0; j < J; ++j) turned[j] = angle_between(from + 12 * j, to + 12 * j);
    for (int64_t i = 0; i < B; ++i) {
        double c0[3], c1[3];
        centre_of(from + 12 * of[i], balls + 4 * i, c0); centre_of(to + 12 * of[i], balls + 4 * i, c1);
        moved[i] = length_between(c0, c1) + turned[of[i]] * balls[4 * i + 3];
    }
}
EXPORT int64_t look(int64_t K, int64_t J, int64_t W, int64_t P, int64_t B, const double *joints, const double *world,
                    const int64_t *of, const double *balls, const double *boxes, const int64_t *pairs,
                    const int64_t *pieces, const int64_t *hulls, const double *extra, const uint8_t *present,
                    const uint8_t *wanted, const double *points, double sharp, const double *within,
                    const double *joints0, const double *world0, const double *gaps0, double *directions,
                    double *gaps, double *room, int64_t most, int64_t *near) {
    int64_t found = 0;
    double *centres = room, *moved = room + 3 * B, *turned = moved + B, *far = turned + J;
    for (int64_t k = 0; k < K; ++k) {
        if (gaps0) motions(J, B, joints0 + 12 * k * J, joints + 12 * k * J, of, balls, turned, moved);
        for (int64_t i = 0; i < B; ++i) centre_of(joints + 12 * (k * J + of[i]), balls + 4 * i, centres + 3 * i);
        for (int64_t i = 0; i < P; ++i) {
            double *u = directions + 3 * (k * P + i), *gap = gaps + k * P + i;
            *gap = 1e3;
            if (!wanted[i]) continue;
            const int64_t other = pairs[2 * i + 1], one = pieces[2 * i], two = pieces[2 * i + 1];
            if (other < 0 && !present[k * W - 1 - other]) continue;
            const double *b = other < 0 ? world + 12 * (k * W - 1 - other) : joints + 12 * (k * J + other), *c = centres + 3 * one;
            double way[3], R[12], bound;
            if (other >= 0) {
                for (int j = 0; j < 3; ++j) way[j] = c[j] - centres[3 * two + j];
                bound = sqrt(dot(way, way)) - balls[4 * one + 3] - balls[4 * two + 3];
            } else bound = from_box(c, b, boxes - 4 * (1 + other), way) - balls[4 * one + 3] - boxes[3 - 4 * (1 + other)];
            if (gaps0 && bound <= within[k * P + i]) {
                const double *b0 = other < 0 ? world0 + 12 * (k * W - 1 - other) : joints0 + 12 * (k * J + other);
                const double before = gaps0[k * P + i], second = other < 0 ? length_between(b0 + 9, b + 9) : moved[two];
                double least = before - moved[one] - second;
                if (least <= within[k * P + i] && before > within[k * P + i])
                    least = before - relative_way(joints0 + 12 * (k * J + pairs[2 * i]), b0, joints + 12 * (k * J + pairs[2 * i]), b, balls + 4 * one);
                if (least > bound) bound = least;
            }
            *gap = bound;
            if (bound > within[k * P + i]) continue;
            relative(joints + 12 * (k * J + pairs[2 * i]), b, R);
            if (u[0] == 0.0 && u[1] == 0.0 && u[2] == 0.0) {
                if (other >= 0) { double x[3]; times_t(b, way, x); for (int j = 0; j < 3; ++j) way[j] = x[j]; }
                const double length = sqrt(dot(way, way)) + 1e-300;
                for (int j = 0; j < 3; ++j) u[j] = way[j] / length;
            }
            const int64_t *h = hulls + 4 * i;
            double down[3] = {-u[0], -u[1], -u[2]}, local[3];
            times_t(R, down, local);
            double rough = dot(u, R + 9) - support_heights(h[1], points + 3 * h[0], local, far) - support_heights(h[3], points + 3 * h[2], u, far) - extra[i];
            rough -= 10.0 / sharp;
            if (rough > within[k * P + i]) { *gap = rough; continue; }
            Side at;
            separate(R, R + 9, h[1], points + 3 * h[0], h[3], points + 3 * h[2], u, sharp, DISTANCES, far, &at);
            *gap = at.s - extra[i];
            if (*gap < within[k * P + i] && found < most) { near[2 * found] = k; near[2 * found + 1] = i; ++found; }
        }
    }
    return found;
}
