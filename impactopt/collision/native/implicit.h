/* Implicit steps that end on events; see collision/implicit.py for the method and its symbols.

   With v = Q (T, -p) + drift t the joints' velocity and the hand's speed, and D = kd + g kp of the joints that are
   not saturated (plus the slope of their friction), g = gamma h, a stage needs v of S r: v = X (rho, -p), where
   X = Q (I + g D Q)^-1 is symmetric, and rho = r_T + g kp r_deviation. Force, penetration and the target are scalars
   beside that. */

#define TERMS (STAGES + 1)
/* of a step up to an event, by which one goes on beyond it, so that the next begins in the new phase; and of a full
   step, below which an event comes at once */
#define JUST_BEYOND 1e-9
#define AT_ONCE 1e-5
/* of the stiffest of contact's modes, the first step; how much an error has to be below what is allowed for longer
   steps; error of a joint's demand, of its limit */
#define FIRST_STEP 0.5
#define WORTH_LONGER 2e-3
#define AIMED_AT 0.2
#define OF_LIMIT 1e-2
#define MOST_TRIES 200

/* law and target in the piece where the step begins, and the inverse of I - g dz'/dz */
typedef struct {
  double f_0, k, d;
  double rates[NZ1];               /* dz/dt at the begin */
  double Z[NZ1][NZ1], G[NZ1], at[NZ1]; /* of dz/dt by z and force; of velocity by z */
  double inverse[NZ1][NZ1], moved[NZ1], mobility;
} Contact;

typedef struct {
  double h, g;
  vec X[N + 1][V], D[V], kp[V];
  Contact contact;
} Resolvent;

/* w_j, and what depends on it; the first of each is the value at the begin. `speeds` have the hand's in their last
   lane used, but for the first */
typedef struct {
  vec torque[TERMS][V], deviation[TERMS][V], speeds[TERMS][V], demand[TERMS][V];
  double impulse[TERMS], penetration[TERMS], rate[TERMS], force[TERMS], target[NZ1][TERMS];
} Series;

enum { OF_NONE, OF_RATE, OF_FORCE, OF_DEMAND, OF_SLIDING, OF_SWITCH };

typedef struct {
  double at;
  int kind, number;
} Event;

/* of each step what those who go back need: the state at its begin, its length, the part of it that was gone, and the
   event that this depends on */
typedef struct {
  int made;
  State states[GRADIENT ? STEPS_AT_ALL + 1 : 1];
  double lengths[GRADIENT ? STEPS_AT_ALL + 1 : 1], parts[GRADIENT ? STEPS_AT_ALL + 1 : 1];
  Event events[GRADIENT ? STEPS_AT_ALL + 1 : 1];
} Tape;

/* ------------------------------------------------------------ polynomials */
INLINE void powers(double theta, double *p) {
  if (theta == 1.0) {
    memcpy(p, AT_ONE, sizeof AT_ONE);
    return;
  }
  FOR(j, TERMS) {
    double x = POWERS[j][j];
    for (int k = j - 1; k >= 0; k--) x = x * theta + POWERS[j][k];
    p[j] = x;
  }
}
/* integrals of p_j from 0 to theta */
INLINE void integrals(double theta, double *p) {
  FOR(j, TERMS) {
    double x = POWERS[j][j] / (j + 1);
    for (int k = j - 1; k >= 0; k--) x = x * theta + POWERS[j][k] / (k + 1);
    p[j] = x * theta;
  }
}
INLINE double value(const double *w, const double *p) {
  double s = w[0];
  for (int j = 1; j < TERMS; j++) s += p[j] * w[j];
  return s;
}
INLINE vec vector(const vec (*w)[V], int i, const double *p) {
  vec s = w[0][i];
  for (int j = 1; j < TERMS; j++) s += p[j] * w[j][i];
  return s;
}
/* derivatives of p_j, and of a sum of w_j p_j */
INLINE void slopes(double theta, double *p) {
  FOR(j, TERMS) {
    double x = j * POWERS[j][j];
    for (int k = j - 1; k >= 1; k--) x = x * theta + k * POWERS[j][k];
    p[j] = x;
  }
}
INLINE double change(const double *w, const double *slope) {
  double s = 0.0;
  for (int j = 1; j < TERMS; j++) s += slope[j] * w[j];
  return s;
}
INLINE vec changes(const vec (*w)[V], int i, const double *slope) {
  vec s = {0};
  for (int j = 1; j < TERMS; j++) s += slope[j] * w[j][i];
  return s;
}
/* Bernstein coefficients */
INLINE void hull(const double *w, double *b) {
  vec s[VECTORS(TERMS)];
  FOR(k, VECTORS(TERMS)) s[k] = (vec){0} + w[0];
  for (int j = 1; j < TERMS; j++) FOR(k, VECTORS(TERMS)) s[k] += w[j] * ((const vec *)HULL[j])[k];
  memcpy(b, s, TERMS * sizeof(double));
}

/* a polynomial's value and slope from its Bernstein coefficients (de Casteljau) */
INLINE double bernstein(const double *b, double t, double *slope) {
  double x[TERMS];
  memcpy(x, b, sizeof x);
  for (int k = STAGES; k > 1; k--) FOR(i, k) x[i] += t * (x[i + 1] - x[i]);
  *slope = STAGES * (x[1] - x[0]);
  return x[0] + t * (x[1] - x[0]);
}

/* the root of one that falls once from above zero to below it: Newton's iterations, held between two bounds */
static double falling_root(const double *b) {
  double low = 0.0, high = 1.0, t = b[0] / (b[0] - b[STAGES]);
  FOR(tries, 60) {
    double slope;
    const double x = bernstein(b, t, &slope);
    if (x > 0.0) low = t;
    else high = t;
    const double next = t - x / slope;
    /* the error goes with the square of the way made last; beyond a bound is what rounding has left */
    if (slope < 0.0 && fabs(next - t) <= 1e-10 * fmax(t, 1e-4)) return fmin(fmax(next, low), high);
    t = next > low && next < high ? next : (low + high) / 2;
  }
  return t;
}

/* Where a polynomial, given by its Bernstein coefficients, falls below zero first; beyond 1: nowhere. It has no more
   roots than they have changes of sign (Lane and Riesenfeld): parts are halved until that decides. */
#define HALVINGS 40
static double first_below(const double *given) {
  double parts[HALVINGS + 1][TERMS], begins[HALVINGS + 1], lengths[HALVINGS + 1];
  int left = 1;
  memcpy(parts[0], given, sizeof parts[0]);
  begins[0] = 0.0, lengths[0] = 1.0;
  while (left) {
    double *b = parts[--left];
    const double begin = begins[left], length = lengths[left];
    int changes = 0, falls = 0;
    double last = 0.0;
    FOR(i, TERMS) {
      if (b[i] == 0.0) continue;
      if (last == 0.0) falls = b[i] < 0.0;
      else changes += (b[i] < 0.0) != (last < 0.0);
      last = b[i];
    }
    if (falls) return begin;
    if (!changes) continue;
    if (left == HALVINGS) return begin;
    if (changes == 1 && b[0] > 0.0) return begin + length * falling_root(b);
    double *right = b, *first = parts[left + 1], row[TERMS];
    memcpy(row, b, sizeof row);
    FOR(k, TERMS) {
      first[k] = row[0];
      right[STAGES - k] = row[STAGES - k];
      FOR(i, STAGES - k) row[i] = 0.5 * (row[i] + row[i + 1]);
    }
    lengths[left] = lengths[left + 1] = length / 2;
    begins[left + 1] = begin, begins[left] = begin + length / 2;
    left += 2;
  }
  return 2.0;
}

/* the largest of a polynomial's values on [0, end], and where; or `most`, where that is more */
static double largest(const double *w, double end, double most, double *where) {
  double b[TERMS], p[TERMS], c[TERMS] = {w[0]}, best = 0.0, high = -INFINITY;
  hull(w, b);
  FOR(i, TERMS) high = fmax(high, b[i]);
  if (high <= most) return most;
  for (int j = 1; j < TERMS; j++) for (int k = 1; k <= j; k++) c[k] += POWERS[j][k] * w[j];
  high = -INFINITY;
  FOR(i, 2 * TERMS) {
    const double t = end * i / (2 * TERMS - 1);
    double x = c[STAGES];
    for (int k = STAGES - 1; k >= 0; k--) x = x * t + c[k];
    if (x > high) high = x, best = t;
  }
  /* from an end too: the largest may lie between it and its neighbour */
  FOR(tries, 5) {
    double slope = 0.0, bend = 0.0;
    for (int k = STAGES; k >= 1; k--) slope = slope * best + k * c[k];
    for (int k = STAGES; k >= 2; k--) bend = bend * best + k * (k - 1) * c[k];
    if (bend < 0.0) best = fmin(fmax(best - slope / bend, 0.0), end);
  }
  powers(best, p);
  high = value(w, p);
  if (high <= most) return most;
  *where = best;
  return high;
}

/* ------------------------------------------------------------ the factor that steps of one length share */
/* joints that are taken in at once: as many of their columns as registers hold */
#define BLOCK (LANES < 4 ? LANES : 4)
#define BLOCKS ((N + BLOCK - 1) / BLOCK)

/* X from Q and D: with columns x of some joints, X - x (1 + g D x_own)^-1 g D x' takes their dampers in */
static void sweep_all(const vec (*Q)[V], Resolvent *r) {
  const vec(*from)[V] = Q;
  if (!BLOCKS) memcpy(r->X, Q, sizeof r->X);
  FOR(first, BLOCKS) {
    const int at = first * BLOCK;
    double M[BLOCK][BLOCK], W[BLOCK][V * LANES] __attribute__((aligned(64)));
    vec x[BLOCK][V];
    FOR(a, BLOCK) FOR(k, V) x[a][k] = at + a <= N ? from[at + a][k] : (vec){0};
    FOR(a, BLOCK) {
      const double by = at + a < N ? r->g * ((double *)r->D)[at + a] : 0.0;
      FOR(b, BLOCK) M[a][b] = (a == b) + by * ((double *)x[a])[at + b];
      FOR(k, V) ((vec *)W[a])[k] = by * x[a][k];
    }
    FOR(a, BLOCK) {
      const double pivot = 1.0 / M[a][a];
      FOR(b, BLOCK) if (b != a) {
        const double by = M[b][a] * pivot;
        FOR(c, BLOCK) M[b][c] -= by * M[a][c];
        FOR(k, V) ((vec *)W[b])[k] -= by * ((vec *)W[a])[k];
      }
      FOR(k, V) ((vec *)W[a])[k] *= pivot;
      FOR(c, BLOCK) M[a][c] *= pivot;
    }
    FOR(j, N + 1) {
      vec column[V];
      FOR(k, V) column[k] = from[j][k];
      FOR(a, BLOCK) FOR(k, V) column[k] -= W[a][j] * x[a][k];
      FOR(k, V) r->X[j][k] = column[k];
    }
    from = (const vec(*)[V])r->X;
  }
}

/* D to D + change at joint i alone */
INLINE void sweep(Resolvent *r, int i, double change) {
  const double pivot = ((double *)r->X[i])[i], factor = r->g * change / (1.0 + r->g * change * pivot);
  vec x[V];
  FOR(k, V) x[k] = r->X[i][k];
  FOR(j, N + 1) {
    const double by = factor * ((double *)x)[j];
    FOR(k, V) r->X[j][k] -= by * x[k];
  }
}

/* D of the joints, as far as they are not saturated now */
INLINE void dampers(const Data *d, const Instant *now, double g, vec *D, vec *kp) {
  FOR(i, V) {
    const bits free_ = now->torque[i] == now->demand[i];
    vec held = d->kd[i];
    kp[i] = (vec){0};
#if STIFFNESS
    kp[i] = SATURATION ? (vec)((bits)d->kp[i] & free_) : d->kp[i];
    held += g * d->kp[i];
#endif
    D[i] = SATURATION ? (vec)((bits)held & free_) : held;
#if FRICTION
    const vec rate = d->joint_velocity[i] + now->u[i];
    D[i] += d->viscous[i] + choose(magnitude(rate) > TRANSITION, (vec){0}, d->coulomb[i] / TRANSITION);
#endif
  }
}

static void contact_here(const Data *d, const State *y, const Instant *now, double g, double mobility, Contact *c) {
  double law[6];
  const double *in[] = {d->law};
  double *out[] = {law};
  law_slopes(in, out, 0, 0, 0);
  const double *mine = law + 3 * now->compressing;
  c->f_0 = mine[0], c->k = mine[1], c->d = mine[2];
  c->mobility = mobility;
#if NZ
  const double force = c->f_0 + c->k * y->penetration + c->d * now->rate;
  const double *at[] = {y->target, &force, d->target};
  double Z[NZ * NZ], *slopes[] = {Z, c->G, c->at}, *rates[] = {c->rates};
  target_slopes(at, slopes, 0, 0, 0);
  target_rates(at, rates, 0, 0, 0);
  double M[NZ][NZ];
  FOR(i, NZ) FOR(j, NZ) {
    c->Z[i][j] = Z[i + NZ * j];
    M[i][j] = (i == j) - g * c->Z[i][j];
    c->inverse[i][j] = i == j;
  }
  FOR(i, NZ) {
    const double pivot = 1.0 / M[i][i];
    FOR(j, NZ) M[i][j] *= pivot, c->inverse[i][j] *= pivot;
    FOR(k, NZ) if (k != i) {
      const double by = M[k][i];
      FOR(j, NZ) M[k][j] -= by * M[i][j], c->inverse[k][j] -= by * c->inverse[i][j];
    }
  }
  FOR(i, NZ) {
    c->moved[i] = 0.0;
    FOR(j, NZ) c->moved[i] += c->inverse[i][j] * c->G[j];
    c->mobility += c->at[i] * c->moved[i];
  }
#endif
}

/* for the phase that begins now, and steps of length h */
static void prepare(const Data *d, const State *y, const Instant *now, double h, Resolvent *r) {
  vec D[V], kp[V];
  const double g = GAMMA_OF_STEPS * h;
  dampers(d, now, g, D, kp);
  int change[N1], changes = 0;
  double *was = (double *)r->D;
  const double *is = (const double *)D;
  if (r->h == h)
    FOR(i, N) if (is[i] != was[i]) change[changes++] = i;
  int anew = r->h != h || changes > N / 4;
  FOR(k, anew ? 0 : changes) {
    const int i = change[k];
    const double more = is[i] - was[i];
    /* taking a stiff damper away again would leave rounding errors */
    if (1.0 + g * more * ((double *)r->X[i])[i] < 1e-3) {
      anew = 1;
      break;
    }
    sweep(r, i, more);
  }
  memcpy(r->D, D, sizeof D);
  if (anew) {
    r->h = h, r->g = g;
    sweep_all((const vec(*)[V])d->frozen->Q, r);
  }
  memcpy(r->kp, kp, sizeof kp);
  contact_here(d, y, now, g, ((double *)r->X[N])[N], &r->contact);
}

/* ------------------------------------------------------------ one step */
typedef struct {
  vec torque[V], deviation[V];
  double impulse, penetration, time, target[NZ1];
} Right;

typedef struct {
  vec speeds[V];
  double impulse, penetration, rate, force, target[NZ1];
} Left;

/* S r, as far as it is needed */
INLINE void solve(const Data *d, const Resolvent *r, const Right *b, Left *x) {
  const Contact *c = &r->contact;
  vec rho[V], a[V];
  FOR(i, V) {
    rho[i] = b->torque[i];
#if STIFFNESS
    rho[i] += r->g * r->kp[i] * b->deviation[i];
#endif
    a[i] = (vec){0};
  }
#if BIAS || JDOT
  if (b->time != 0.0) FOR(i, V) {
    a[i] = d->frozen->drift[i] * b->time;
    rho[i] -= r->g * r->D[i] * a[i];
  }
#endif
  add_columns(r->X, N, (const double *)rho, a);
  const double own = ((double *)r->X[N])[N];
  double rate = a[N / LANES][N % LANES] - own * b->impulse, held[NZ1];
  FOR(i, NZ) {
    held[i] = 0.0;
    FOR(k, NZ) held[i] += c->inverse[i][k] * b->target[k];
    rate -= c->at[i] * held[i];
  }
  const double slope = c->k * r->g + c->d;
  x->force = (c->k * b->penetration + slope * rate) / (1.0 + slope * r->g * c->mobility);
  x->impulse = b->impulse + r->g * x->force;
  x->rate = rate - r->g * c->mobility * x->force;
  x->penetration = b->penetration + r->g * x->rate;
  FOR(i, NZ) x->target[i] = held[i] + r->g * c->moved[i] * x->force;
  FOR(i, V) x->speeds[i] = a[i] - r->X[N][i] * x->impulse;
}

INLINE void make_series(const Data *d, const State *y, const Instant *now, const Resolvent *r, Series *s) {
  const Contact *c = &r->contact;
  const double h = r->h, by_gamma = 1.0 / GAMMA_OF_STEPS;
  Right b;
  Left x;
  s->impulse[0] = y->impulse;
  s->penetration[0] = y->penetration;
  s->rate[0] = now->rate;
  s->force[0] = c->f_0 + c->k * y->penetration + c->d * now->rate;
  b.impulse = h * s->force[0];
  b.penetration = h * now->rate;
  b.time = h;
  FOR(i, NZ) s->target[i][0] = y->target[i], b.target[i] = h * c->rates[i];
  FOR(i, V) {
    s->torque[0][i] = y->torque[i];
    s->deviation[0][i] = STIFFNESS ? y->deviation[i] : (vec){0};
    s->speeds[0][i] = now->u[i];
    s->demand[0][i] = now->demand[i];
    b.torque[i] = h * now->net[i];
    b.deviation[i] = -h * now->u[i];
  }
  solve(d, r, &b, &x);
  FOR(i, V) {
    vec net = b.torque[i] - r->g * r->D[i] * x.speeds[i];
#if STIFFNESS
    net += r->g * r->kp[i] * b.deviation[i];
#endif
    s->torque[1][i] = net;
    s->deviation[1][i] = b.deviation[i] - r->g * x.speeds[i];
    s->speeds[1][i] = x.speeds[i];
  }
  s->impulse[1] = x.impulse;
  s->penetration[1] = x.penetration;
  s->rate[1] = x.rate;
  s->force[1] = x.force;
  FOR(i, NZ) s->target[i][1] = x.target[i];
  servo(d, s->speeds[1], s->deviation[1], s->demand[1]);
  for (int j = 1; j < STAGES; j++) {
    b.impulse = s->impulse[j];
    b.penetration = s->penetration[j];
    b.time = j == 1 ? h : 0.0;
    FOR(i, NZ) b.target[i] = s->target[i][j];
    FOR(i, V) b.torque[i] = s->torque[j][i], b.deviation[i] = s->deviation[j][i];
    solve(d, r, &b, &x);
    FOR(i, V) {
      vec net = -r->D[i] * x.speeds[i];
#if STIFFNESS
      net += r->kp[i] * b.deviation[i];
#endif
      s->torque[j + 1][i] = h * net;
      s->deviation[j + 1][i] = -h * x.speeds[i];
      s->speeds[j + 1][i] = (x.speeds[i] - s->speeds[j][i]) * by_gamma;
    }
    s->impulse[j + 1] = h * x.force;
    s->penetration[j + 1] = h * x.rate;
    s->rate[j + 1] = (x.rate - s->rate[j]) * by_gamma;
    s->force[j + 1] = (x.force - s->force[j]) * by_gamma;
    FOR(i, NZ) s->target[i][j + 1] = (x.target[i] - s->target[i][j]) * by_gamma;
    servo(d, s->speeds[j + 1], s->deviation[j + 1], s->demand[j + 1]);
  }
}

/* what a further term would add to the hand's speed and the joints' demands, of what is allowed */
INLINE double error_of(const Data *d, const Series *s, double scale) {
  double error = fabs(s->rate[STAGES]) / fmax(scale, fabs(s->rate[1]));
  error = fmax(error, fabs(s->impulse[STAGES]) / fmax(s->impulse[0], fabs(s->impulse[1])));
  error *= LEFT_OUT / TOLERANCE;
#if SATURATION
  vec most = {0};
  FOR(i, V) {
    const vec of = magnitude(s->demand[STAGES][i]) / d->limit[i];
    most = choose(of > most, of, most);
  }
  FOR(l, LANES) error = fmax(error, most[l] * (LEFT_OUT / OF_LIMIT));
#endif
  return error;
}

/* ------------------------------------------------------------ events */
/* what falls below zero before the first event so far takes its place */
static void look_at(const double *b, double sign, double level, int kind, int number, Event *e) {
  double mine[TERMS], lowest = INFINITY;
  FOR(i, TERMS) {
    mine[i] = sign * b[i] + level;
    lowest = mine[i] < lowest ? mine[i] : lowest;
  }
  if (lowest >= 0.0) return;
  const double at = first_below(mine);
  if (at < e->at) *e = (Event){.at = at, .kind = kind, .number = number};
}

/* a joint's series against a level: stays within it, or beyond */
static void look_at_joint(const vec (*w)[V], int i, double offset, double level, int kind, Event *e) {
  double mine[TERMS], b[TERMS];
  FOR(j, TERMS) mine[j] = ((const double *)w[j])[i];
  mine[0] += offset;
  hull(mine, b);
  if (fabs(mine[0]) <= level) { /* as what is at its level counts elsewhere */
    look_at(b, 1.0, level, kind, i, e);
    look_at(b, -1.0, level, kind, i, e);
  } else {
    look_at(b, mine[0] < 0.0 ? -1.0 : 1.0, -level, kind, i, e);
  }
}

/* whether a joint's series may cross the level in this step, a joint a lane: from its terms' sizes, and where these
   leave it open from its hull */
INLINE bits may_cross(const vec (*w)[V], int i, vec offset, vec level) {
  vec reach = BOUND[1] * magnitude(w[1][i]);
  for (int j = 2; j < TERMS; j++) reach += BOUND[j] * magnitude(w[j][i]);
  const vec start = w[0][i] + offset, size = magnitude(start);
  const bits open = magnitude(size - level) <= reach;
  if (!any(open)) return open;
  const bits within = size <= level, sign = (bits)start & SIGN_BIT;
  bits crosses = {0};
  for (int k = 1; k < TERMS; k++) {
    vec b = start;
    for (int j = 1; j < TERMS; j++) b += HULL[j][k] * w[j][i];
    const vec out = magnitude(b) - level, in = level - (vec)((bits)b ^ sign);
    crosses |= choose(within, out, in) > 0.0;
  }
  return crosses & open;
}

static void find_event(const Data *d, const State *y, const Instant *now, const Series *s, double end, Event *e) {
  double b[TERMS];
  *e = (Event){.at = end};
  hull(s->rate, b);
  look_at(b, now->compressing ? 1.0 : -1.0, 0.0, OF_RATE, 0, e);
  if (!now->compressing) hull(s->force, b), look_at(b, 1.0, 0.0, OF_FORCE, 0, e);
#if SATURATION
  FOR(i, V) {
    const bits may = may_cross(s->demand, i, (vec){0}, d->limit[i]) & (bits)(d->kept[i] > 0.0);
    if (any(may)) FOR(l, LANES) if (may[l])
      look_at_joint(s->demand, i * LANES + l, 0.0, d->limit[i][l], OF_DEMAND, e);
  }
#endif
#if FRICTION
  FOR(i, V) {
    const bits may = may_cross(s->speeds, i, d->joint_velocity[i], (vec){0} + TRANSITION) & (bits)(d->kept[i] > 0.0);
    if (any(may)) FOR(l, LANES) if (may[l])
      look_at_joint(s->speeds, i * LANES + l, d->joint_velocity[i][l], TRANSITION, OF_SLIDING, e);
  }
#endif
#if SWITCHES
  double values[SWITCHES], by_z[SWITCHES * NZ1], by_force[SWITCHES];
  const double *in[] = {y->target, &s->force[0], d->target};
  double *out[] = {values, by_z, by_force};
  switch_slopes(in, out, 0, 0, 0);
  FOR(k, SWITCHES) {
    double w[TERMS] = {values[k]};
    for (int j = 1; j < TERMS; j++) {
      w[j] = by_force[k] * s->force[j];
      FOR(i, NZ) w[j] += by_z[k + SWITCHES * i] * s->target[i][j];
    }
    hull(w, b);
    const double side = b[0] != 0.0 ? b[0] : b[1];
    look_at(b, side < 0.0 ? -1.0 : 1.0, 0.0, OF_SWITCH, k, e);
  }
#endif
}

INLINE void move(State *y, const Series *s, double h, double theta) {
  double p[TERMS];
#if SECOND_INTEGRALS
  integrals(theta, p);
  FOR(i, V) {
    vec more = p[0] * s->torque[0][i];
    for (int j = 1; j < TERMS; j++) more += p[j] * s->torque[j][i];
    y->torque2[i] += h * more;
  }
  FOR(j, TERMS) y->impulse2 += h * p[j] * s->impulse[j];
#endif
#if PEAK
  double where;
  y->peak = largest(s->force, theta, y->peak, &where);
#endif
  powers(theta, p);
  FOR(i, V) {
    y->torque[i] = vector(s->torque, i, p);
    if (STIFFNESS) y->deviation[i] = vector(s->deviation, i, p);
  }
  y->impulse = value(s->impulse, p);
  y->penetration = value(s->penetration, p);
  FOR(i, NZ) y->target[i] = value(s->target[i], p);
  y->time += h * theta;
}

/* ------------------------------------------------------------ from y to separation, or the freeze's end */
/* an instant within a step, with no more of a state than columns need */
INLINE void within(const Data *d, const State *y, const Instant *now, const Series *s, const Contact *c, double part,
                   State *then, Instant *at) {
  double p[TERMS];
  powers(part, p);
  then->penetration = value(s->penetration, p);
  at->rate = value(s->rate, p);
  at->target_speed = now->target_speed;
  FOR(i, NZ) for (int j = 1; j < TERMS; j++) at->target_speed += c->at[i] * p[j] * s->target[i][j];
  at->speed = at->rate + at->target_speed;
  FOR(i, V) {
    at->u[i] = vector(s->speeds, i, p);
    at->demand[i] = vector(s->demand, i, p);
  }
  torques(d, at);
}

/* the columns of the histories that lie in a step; the number of the next */
static int sample(const Data *d, const State *y, const Instant *now, const Series *s, const Contact *c, double h,
                  double theta, const Record *record, int column) {
  State then;
  Instant at;
  for (;; column++) {
    const double part = (column * (EVERY * LENGTH) - y->time) / h;
    if (part >= theta || column >= record->columns - 1) return column;
    within(d, y, now, s, c, part, &then, &at);
    then.time = column * (EVERY * LENGTH);
    write_column(d, &then, &at, record, column);
  }
}

static Instant run(const Data *d, State *y, int steps, const Record *record, Tape *tape) {
  Instant now;
  Resolvent r = {.h = 0.0};
  Series s;
  Event e;
  int made = 0, column = 0, repeated = 0;
  double scale = 0.0, h = 0.0;
  for (;; made++) {
    look(d, y, &now);
    judge(d, y, &now);
    if (record && !made) write_column(d, y, &now, record, column++);
    if (made == steps || !now.contact || !(y->time < d->until)) break;
    const double left = d->until - y->time;
    scale = fmax(scale, fabs(now.rate));
    if (h == 0.0) {
      contact_here(d, y, &now, 0.0, ((double *)d->frozen->Q[N])[N], &r.contact);
      const Contact *c = &r.contact;
      const double rate = fmax(c->d * c->mobility, sqrt(fmax(c->k * c->mobility, 0.0)));
      h = rate * left > FIRST_STEP ? FIRST_STEP / rate : left;
    }
    double error = 0.0;
    FOR(tries, MOST_TRIES) {
      prepare(d, y, &now, h, &r);
      make_series(d, y, &now, &r, &s);
      error = error_of(d, &s, scale);
      if (!(error > 1.0)) break;
      h *= fmax(0.2, 0.9 * pow(error, -1.0 / TERMS));
    }
    const double end = fmin(1.0, left / h);
    find_event(d, y, &now, &s, end, &e);
    /* events that follow each other at once, because rounding hides that they are over: farther each time */
    repeated = e.kind && e.at < AT_ONCE && repeated < 8 ? repeated + 1 : 0;
    const double beyond = JUST_BEYOND * fmax(e.at, AT_ONCE * (1 << 3 * repeated));
    const double theta = e.kind ? fmin(end, e.at + beyond) : end;
    if (record) column = sample(d, y, &now, &s, &r.contact, h, theta, record, column);
    if (GRADIENT) {
      tape->states[made] = *y, tape->lengths[made] = h, tape->parts[made] = theta, tape->events[made] = e;
      if (theta == end) tape->events[made].kind = OF_NONE;
    }
    move(y, &s, h, theta);
    if (theta == end && end < 1.0) y->time = d->until;
    if (!e.kind && error < WORTH_LONGER && left > 2.0 * h) {
      const double longer = pow(AIMED_AT / error, 1.0 / TERMS);
      h *= longer < 4.0 ? longer : 4.0;
    }
  }
  if (GRADIENT) tape->states[made] = *y, tape->made = made;
  no_number(d, y, &now);
  if (record) {
    column = column < record->columns ? column : record->columns - 1;
    write_column(d, y, &now, record, column);
    repeat_column(record, column);
  }
  return now;
}
