/* Implicit steps that end on events; see collision/implicit.py for the method and its symbols.

   With v = Q (T, -p) + drift t the joints' velocity and the hand's speed, and D = kd + g kp of the joints that are
   not saturated (plus the slope of their friction), g = gamma h, a stage needs v of S r: v = X (rho, -p), where
   X = Q (I + g D Q)^-1 and rho = r_T + g kp r_deviation. Gains of one number a joint have X symmetric. Force,
   penetration and the target are scalars beside that. What law and target have beyond their slopes at the step's begin
   acts as inputs n of these scalars, polynomials as the state is one; see implicit_bend.h, which finds
   them. */

#define TERMS (STAGES + 1)
/* of a step up to an event, by which one goes on beyond it, so that the next begins in the new phase; and of a full
   step, below which an event comes at once */
#define JUST_BEYOND 1e-9
#define AT_ONCE 1e-5
/* of the stiffest of contact's modes, the first step; how much an error has to be below what is allowed for longer
   steps; error of a joint's demand, of its limit; and
   what is allowed of a place at which the target changes, of what is allowed else */
#define FIRST_STEP 0.5
#define WORTH_LONGER 2e-3
#define AIMED_AT 0.2
/* likewise where law or target bend, which costs a factor anew in any case; the first step's change of speed, of the
   speed; and a step that Newton's method has not found, once more */
#define BENT_WORTH_LONGER 0.1
#define LITTLE 0.1
#define SHORTER 0.3
/* of a force that begins without a slope, as x^1.5, the first step's change of speed; and of the time that is left to
   separation, a step that comes near it: a force that ends so is followed by ever shorter ones, down to the first's */
#define LITTLE_OF_FLAT 3e-4
#define NEAR_SEPARATION 0.6
#define OF_LIMIT 1e-2
#define OF_PLACE 0.1
#define MOST_TRIES 200

/* law and target in the piece where the step begins, and the inverse of I - g dz'/dz */
typedef struct {
  double force, k, d;              /* at the begin, and its slopes by penetration and rate */
  double rates[NZ1];               /* dz/dt at the begin */
  double Z[NZ1][NZ1], G[NZ1], at[NZ1]; /* of dz/dt by z and force; of velocity by z */
  double inverse[NZ1][NZ1], moved[NZ1], mobility;
  double yields;                   /* mobility [1/kg] without what holds within a step */
} Contact;

/* `rows` are those of X, which is by columns; of gains that are matrices D is by columns too */
#define GAIN_MATRIX (KD_MATRIX || KP_MATRIX)
typedef struct {
  double h, g;
  vec X[N + 1][V];
#if GAIN_MATRIX
  vec rows[N + 1][V], D[N1][V], free[V];
#else
  vec D[V], kp[V];
#endif
  Contact contact;
} Resolvent;

/* additional inputs of a stage: of the force, the target's rates and its velocity */
#define BENDS (LAW_BENDS || TARGET_BENDS)
#define INPUTS (1 + (TARGET_BENDS ? NZ + 1 : 0))
typedef double Inputs[BENDS ? TERMS : 1][INPUTS];

/* w_j, and what depends on it; the first of each is the value at the begin. `speeds` have the hand's in their last
   lane used, but for the first */
typedef struct {
  vec torque[TERMS][V], deviation[TERMS][V], speeds[TERMS][V], demand[TERMS][V];
  double impulse[TERMS], penetration[TERMS], rate[TERMS], force[TERMS], target[NZ1][TERMS];
} Series;

enum { OF_NONE, OF_RATE, OF_FORCE, OF_DEMAND, OF_SLIDING, OF_SWITCH, OF_SEPARATION };

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
