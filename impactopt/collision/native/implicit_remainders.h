/* Nonlinear laws and targets within a step; see collision/implicit.py.

   Force, target rates and target velocity have remainders n of second order beyond their slopes at the step's begin.
   Each is a polynomial that interpolates them at NODES places, and an input of the linear model. Observations at these
   places, o = (penetration, rate, target), are linear in n with a matrix K, which the series of a model at rest give.
   So n = R(o(n)) are a few scalar equations for Newton's method, whose number does not depend on that of the joints. */
#if NONLINEAR
#define OBSERVED (2 + (TARGET_NONLINEAR ? NZ : 0))
#define UNKNOWNS (NODES * INPUTS)
/* Newton's method: iterations, and the largest relative change of the last one */
#define MAX_NEWTON_ITERATIONS 12
#define CONVERGED (0.03 * sqrt(TOLERANCE)) /* its error is about the square of that */

typedef struct {
  Inputs n;
  double observed[OBSERVED][NODES], K[OBSERVED][INPUTS][NODES][NODES];
  double by[NODES][INPUTS][OBSERVED];       /* slopes of R at the nodes */
  double matrix[UNKNOWNS][UNKNOWNS];    /* I - dR K, then its LU factors */
  int pivots[UNKNOWNS];
} Remainders;

INLINE double at_node(const double *w, int node) {
  double x = AT_NODES[node][0] * w[0];
  for (int j = 1; j < TERMS; j++) x += AT_NODES[node][j] * w[j];
  return x;
}

static void observe(const Series *s, double (*observed)[NODES]) {
  FOR(i, NODES) {
    observed[0][i] = at_node(s->penetration, i);
    observed[1][i] = at_node(s->rate, i);
    for (int z = 0; z < OBSERVED - 2; z++) observed[2 + z][i] = at_node(s->target[z], i);
  }
}

/* K: the response of each node to each input. An input n_1 = 1 / gamma acts on the first stage alone, as later terms
   cancel it; its response gives those to all other terms, by the table ANSWERS. */
static void node_responses(const Data *d, const Resolvent *r, Series *s, Remainders *b) {
  FOR(a, INPUTS) {
    Inputs unit = {{0}};
    StageInput none;
    memset(&none, 0, sizeof none);
    memset(s->torque[0], 0, sizeof s->torque[0]), memset(s->deviation[0], 0, sizeof s->deviation[0]);
    memset(s->speeds[0], 0, sizeof s->speeds[0]), memset(s->demand[0], 0, sizeof s->demand[0]);
    s->impulse[0] = s->penetration[0] = s->rate[0] = s->force[0] = 0.0;
    FOR(i, NZ) s->target[i][0] = 0.0;
    unit[1][a] = 1.0 / GAMMA_OF_STEPS;
    /* stages after the first see n_j + gamma n_(j+1) = 0 */
    unit[2][a] = -1.0 / (GAMMA_OF_STEPS * GAMMA_OF_STEPS);
    for (int j = 3; j < TERMS; j++) unit[j][a] = -unit[j - 1][a] / GAMMA_OF_STEPS;
    make_terms(d, r, &none, (const double(*)[INPUTS])unit, s);
    if (a == INPUTS - 1 && TARGET_NONLINEAR) for (int j = 1; j < TERMS; j++) s->rate[j] += unit[j][a];
    FOR(o, OBSERVED) {
      const double *w = o == 0 ? s->penetration : o == 1 ? s->rate : s->target[o - 2];
      FOR(i, NODES) FOR(l, NODES) b->K[o][a][i][l] = 0.0;
      FOR(k, STAGES) FOR(i, NODES) FOR(l, NODES) b->K[o][a][i][l] += w[k + 1] * ANSWERS[k][i][l];
    }
    if (a == INPUTS - 1 && TARGET_NONLINEAR) FOR(i, NODES) b->K[1][a][i][i] -= 1.0;
  }
}

/* Remainders R at a node, and their slopes; `size` becomes the magnitude of the functions themselves. */
static void remainders(const Data *d, const State *y, const Instant *now, const Contact *c, int node, Remainders *b,
                       double *R, double *size) {
  double o[OBSERVED], law[3];
  FOR(k, OBSERVED) o[k] = b->observed[k][node];
  const double x = o[0] - y->penetration, rate = o[1] - now->rate;
  law_and_slopes(d, o[0], o[1], now->compressing, law);
  R[0] = law[0] - (c->force + c->k * x + c->d * rate);
  size[0] = fmax(size[0], fabs(law[0]));
  FOR(a, INPUTS) FOR(k, OBSERVED) b->by[node][a][k] = 0.0;
  b->by[node][0][0] = law[1] - c->k, b->by[node][0][1] = law[2] - c->d;
#if TARGET_NONLINEAR
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

/* I - dR K and its LU factors; unknowns are the first input's nodes, then the next one's. */
static void factor_remainders(Remainders *b) {
  FOR(a, INPUTS) FOR(i, NODES) FOR(e, INPUTS) FOR(l, NODES) {
    double x = a == e && i == l;
    FOR(o, OBSERVED) x -= b->by[i][a][o] * b->K[o][e][i][l];
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
static void solve_remainders(const Remainders *b, double *x) {
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
static void solve_remainders_transposed(const Remainders *b, double *x) {
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

/* Coefficients of polynomials from their values at the nodes. */
INLINE void from_nodes(const double *at, Inputs n) {
  FOR(j, TERMS) FOR(a, INPUTS) {
    n[j][a] = 0.0;
    FOR(i, NODES) n[j][a] += FROM_NODES[j][i] * at[a * NODES + i];
  }
}

/* Slopes of the remainders and factors at a solved series, for derivatives. */
static void relinearize(const Data *d, const State *y, const Instant *now, const Resolvent *r, const Series *s,
                        Remainders *b) {
  double R[INPUTS], size[INPUTS] = {0};
  observe(s, b->observed);
  FOR(i, NODES) remainders(d, y, now, &r->contact, i, b, R, size);
  factor_remainders(b);
}

/* Series of a step with nonlinear law or target; returns whether Newton's method has converged. */
static int nonlinear_series(const Data *d, const State *y, const Instant *now, const Resolvent *r, Remainders *b,
                            Series *s) {
  static const Inputs none;
  double base[OBSERVED][NODES], n[UNKNOWNS] = {0}, change[UNKNOWNS], largest_[INPUTS];
  int found = 0;
  node_responses(d, r, s, b);
  make_series(d, y, now, r, none, s);
  observe(s, base);
  for (int tries = 0; tries < MAX_NEWTON_ITERATIONS && !found; tries++) {
    FOR(o, OBSERVED) FOR(i, NODES) {
      b->observed[o][i] = base[o][i];
      FOR(a, INPUTS) FOR(l, NODES) b->observed[o][i] += b->K[o][a][i][l] * n[a * NODES + l];
    }
    FOR(a, INPUTS) largest_[a] = 0.0;
    FOR(i, NODES) {
      double R[INPUTS];
      remainders(d, y, now, &r->contact, i, b, R, largest_);
      FOR(a, INPUTS) change[a * NODES + i] = R[a] - n[a * NODES + i];
    }
    factor_remainders(b);
    solve_remainders(b, change);
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
} Remainders;
#endif

/* Series of a step; returns whether it has converged. */
static int step_series(const Data *d, const State *y, const Instant *now, const Resolvent *r, Remainders *b,
                       Series *s) {
#if NONLINEAR
  return nonlinear_series(d, y, now, r, b, s);
#else
  make_series(d, y, now, r, 0, s);
  return 1;
#endif
}
