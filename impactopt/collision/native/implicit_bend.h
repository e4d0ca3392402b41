/* What bends in law and target, within a step; see collision/implicit.py.

   Beyond their slopes at the step's begin, force, target's rates and target's velocity have remainders n of the second
   order. Each is a polynomial that is right at NODES places of the step, and acts on the linear rest as an input. What
   is seen at these places, o = (penetration, rate, target), answers n with a matrix K, which a series from rest gives.
   So n = R(o(n)) are a few scalar equations, for Newton's method, however many joints there are. */
#if BENDS
#define SEEN (2 + (TARGET_BENDS ? NZ : 0))
#define UNKNOWNS (NODES * INPUTS)
/* iterations, and of its size the last one's change */
#define MOST_ITERATIONS 12
#define CONVERGED (0.03 * sqrt(TOLERANCE)) /* its error is the square of that */

typedef struct {
  Inputs n;
  double seen[SEEN][NODES], K[SEEN][INPUTS][NODES][NODES];
  double by[NODES][INPUTS][SEEN];       /* slopes of R */
  double matrix[UNKNOWNS][UNKNOWNS];    /* I - dR K, and its factors */
  int pivots[UNKNOWNS];
} Bend;

INLINE double at_node(const double *w, int node) {
  double x = AT_NODES[node][0] * w[0];
  for (int j = 1; j < TERMS; j++) x += AT_NODES[node][j] * w[j];
  return x;
}

static void see(const Series *s, double (*seen)[NODES]) {
  FOR(i, NODES) {
    seen[0][i] = at_node(s->penetration, i);
    seen[1][i] = at_node(s->rate, i);
    for (int z = 0; z < SEEN - 2; z++) seen[2 + z][i] = at_node(s->target[z], i);
  }
}

/* how a node sees an input that acts as n_1 = 1 / gamma alone, and that is taken on by each stage */
static void answers(const Data *d, const Resolvent *r, Series *s, Bend *b) {
  FOR(a, INPUTS) {
    Inputs unit = {{0}};
    Right none;
    memset(&none, 0, sizeof none);
    memset(s->torque[0], 0, sizeof s->torque[0]), memset(s->deviation[0], 0, sizeof s->deviation[0]);
    memset(s->speeds[0], 0, sizeof s->speeds[0]), memset(s->demand[0], 0, sizeof s->demand[0]);
    s->impulse[0] = s->penetration[0] = s->rate[0] = s->force[0] = 0.0;
    FOR(i, NZ) s->target[i][0] = 0.0;
    unit[1][a] = 1.0 / GAMMA_OF_STEPS;
    /* the stage after the first takes n_1 + gamma n_2 = 0 */
    unit[2][a] = -1.0 / (GAMMA_OF_STEPS * GAMMA_OF_STEPS);
    for (int j = 3; j < TERMS; j++) unit[j][a] = -unit[j - 1][a] / GAMMA_OF_STEPS;
    make_terms(d, r, &none, (const double(*)[INPUTS])unit, s);
    if (a == INPUTS - 1 && TARGET_BENDS) for (int j = 1; j < TERMS; j++) s->rate[j] += unit[j][a];
    FOR(o, SEEN) {
      const double *w = o == 0 ? s->penetration : o == 1 ? s->rate : s->target[o - 2];
      FOR(i, NODES) FOR(l, NODES) b->K[o][a][i][l] = 0.0;
      FOR(k, STAGES) FOR(i, NODES) FOR(l, NODES) b->K[o][a][i][l] += w[k + 1] * ANSWERS[k][i][l];
    }
    if (a == INPUTS - 1 && TARGET_BENDS) FOR(i, NODES) b->K[1][a][i][i] -= 1.0;
  }
}

/* the remainders at a node, and their slopes; `size` gets what they are remainders of */
static void remainders(const Data *d, const State *y, const Instant *now, const Contact *c, int node, Bend *b,
                       double *R, double *size) {
  double o[SEEN], law[3];
  FOR(k, SEEN) o[k] = b->seen[k][node];
  const double x = o[0] - y->penetration, rate = o[1] - now->rate;
  law_here(d, o[0], o[1], now->compressing, law);
  R[0] = law[0] - (c->force + c->k * x + c->d * rate);
  size[0] = fmax(size[0], fabs(law[0]));
  FOR(a, INPUTS) FOR(k, SEEN) b->by[node][a][k] = 0.0;
  b->by[node][0][0] = law[1] - c->k, b->by[node][0][1] = law[2] - c->d;
#if TARGET_BENDS
  double rates[NZ1], Z[NZ * NZ], G[NZ1], at[NZ1];
  const double *in[] = {o + 2, law, d->target};
  double *out[] = {rates}, *slopes_[] = {Z, G, at};
  target_rates(in, out, 0, 0, 0);
  target_slopes(in, slopes_, 0, 0, 0);
  double speed = call(target_velocity, o + 2, d->target, 0) - now->target_speed;
  FOR(i, NZ) {
    double *by = b->by[node][1 + i];
    R[1 + i] = rates[i] - c->rates[i] - c->G[i] * (law[0] - c->force);
    by[0] = (G[i] - c->G[i]) * law[1], by[1] = (G[i] - c->G[i]) * law[2];
    FOR(k, NZ) {
      R[1 + i] -= c->Z[i][k] * (o[2 + k] - y->target[k]);
      by[2 + k] = Z[i + NZ * k] - c->Z[i][k];
    }
    size[1 + i] = fmax(size[1 + i], fabs(rates[i]));
    speed -= c->at[i] * (o[2 + i] - y->target[i]);
    b->by[node][INPUTS - 1][2 + i] = at[i] - c->at[i];
  }
  R[INPUTS - 1] = speed;
  size[INPUTS - 1] = fmax(size[INPUTS - 1], fabs(o[1]));
#endif
}

/* I - dR K, and its LU factors; unknowns are node by node of the first input, then of the next */
static void factor_bend(Bend *b) {
  FOR(a, INPUTS) FOR(i, NODES) FOR(e, INPUTS) FOR(l, NODES) {
    double x = a == e && i == l;
    FOR(o, SEEN) x -= b->by[i][a][o] * b->K[o][e][i][l];
    b->matrix[a * NODES + i][e * NODES + l] = x;
  }
  FOR(c, UNKNOWNS) {
    int best = c;
    for (int i = c + 1; i < UNKNOWNS; i++) if (fabs(b->matrix[i][c]) > fabs(b->matrix[best][c])) best = i;
    b->pivots[c] = best;
    if (best != c) FOR(k, UNKNOWNS) {
      const double x = b->matrix[c][k];
      b->matrix[c][k] = b->matrix[best][k], b->matrix[best][k] = x;
    }
    for (int i = c + 1; i < UNKNOWNS; i++) {
      const double by = b->matrix[i][c] /= b->matrix[c][c];
      for (int k = c + 1; k < UNKNOWNS; k++) b->matrix[i][k] -= by * b->matrix[c][k];
    }
  }
}
static void solve_bend(const Bend *b, double *x) {
  FOR(c, UNKNOWNS) {
    const double y = x[b->pivots[c]];
    x[b->pivots[c]] = x[c], x[c] = y;
    for (int i = c + 1; i < UNKNOWNS; i++) x[i] -= b->matrix[i][c] * y;
  }
  for (int c = UNKNOWNS - 1; c >= 0; c--) {
    for (int k = c + 1; k < UNKNOWNS; k++) x[c] -= b->matrix[c][k] * x[k];
    x[c] /= b->matrix[c][c];
  }
}
static void solve_bend_transposed(const Bend *b, double *x) {
  FOR(c, UNKNOWNS) {
    FOR(k, c) x[c] -= b->matrix[k][c] * x[k];
    x[c] /= b->matrix[c][c];
  }
  for (int c = UNKNOWNS - 1; c >= 0; c--) {
    for (int i = c + 1; i < UNKNOWNS; i++) x[c] -= b->matrix[i][c] * x[i];
    const double y = x[c];
    x[c] = x[b->pivots[c]], x[b->pivots[c]] = y;
  }
}

/* coefficients of polynomials from their values at the nodes */
INLINE void from_nodes(const double *at, Inputs n) {
  FOR(j, TERMS) FOR(a, INPUTS) {
    n[j][a] = 0.0;
    FOR(i, NODES) n[j][a] += FROM_NODES[j][i] * at[a * NODES + i];
  }
}

/* slopes and factors at what a series has at the nodes */
static void settle(const Data *d, const State *y, const Instant *now, const Resolvent *r, const Series *s, Bend *b) {
  double R[INPUTS], size[INPUTS] = {0};
  see(s, b->seen);
  FOR(i, NODES) remainders(d, y, now, &r->contact, i, b, R, size);
  factor_bend(b);
}

/* the series of a step of law and target as they are; whether Newton's method has found it */
static int bent_series(const Data *d, const State *y, const Instant *now, const Resolvent *r, Bend *b, Series *s) {
  static const Inputs none;
  double base[SEEN][NODES], n[UNKNOWNS] = {0}, change[UNKNOWNS], largest_[INPUTS];
  int found = 0;
  answers(d, r, s, b);
  make_series(d, y, now, r, none, s);
  see(s, base);
  for (int tries = 0; tries < MOST_ITERATIONS && !found; tries++) {
    FOR(o, SEEN) FOR(i, NODES) {
      b->seen[o][i] = base[o][i];
      FOR(a, INPUTS) FOR(l, NODES) b->seen[o][i] += b->K[o][a][i][l] * n[a * NODES + l];
    }
    FOR(a, INPUTS) largest_[a] = 0.0;
    FOR(i, NODES) {
      double R[INPUTS];
      remainders(d, y, now, &r->contact, i, b, R, largest_);
      FOR(a, INPUTS) change[a * NODES + i] = R[a] - n[a * NODES + i];
    }
    factor_bend(b);
    solve_bend(b, change);
    found = 1;
    FOR(a, INPUTS) FOR(i, NODES) {
      const double by = change[a * NODES + i];
      n[a * NODES + i] += by;
      found &= fabs(by) <= CONVERGED * largest_[a];
    }
  }
  from_nodes(n, b->n);
  make_series(d, y, now, r, (const double(*)[INPUTS])b->n, s);
  return found;
}
#else
typedef struct {
  int none;
} Bend;
#endif

/* the series of a step; whether it has been found */
static int series_of(const Data *d, const State *y, const Instant *now, const Resolvent *r, Bend *b, Series *s) {
#if BENDS
  return bent_series(d, y, now, r, b, s);
#else
  make_series(d, y, now, r, 0, s);
  return 1;
#endif
}
