/* Implicit steps that end on events; see collision/implicit.py for the method and its symbols.

   The joints' velocity and the hand's speed are v = Q (T, -p) + drift t. With g = gamma h and D = kd + g kp of the
   joints that are not saturated (plus the slope of their friction), a stage solves v = X (rho, -p), where
   X = Q (I + g D Q)^-1 and rho = r_T + g kp r_deviation. X is symmetric where gains are one number a joint. Force,
   penetration and the target are scalar equations beside that. Nonlinear parts of law and target (remainders beyond
   their slopes at the step's begin) act as inputs n of these equations, polynomials as the state is one; see
   implicit_remainders.h. */

#define TERMS (STAGES + 1)

/* Constants of events and step control. Errors are relative to the tolerance. */
/* Part of its length by which a step passes an event, so that the next one begins in the new phase. */
#define EVENT_OVERSHOOT 1e-9
/* Part of a step before which an event is immediate: rounding may have hidden that the last one is over. */
#define IMMEDIATE_EVENT 1e-5
/* Phase [rad] of the contact's fastest mode in the first step. With a nonlinear law instead, the relative change of the
   hand's speed in it; the second where the force begins without a slope, as x^1.5. */
#define FIRST_STEP_PHASE 0.5
#define FIRST_SPEED_CHANGE 0.1
#define FIRST_SPEED_CHANGE_FLAT 3e-4
/* Error below which the next step is longer, for an error of AIMED_ERROR. That costs a factorization, which nonlinear
   laws and targets need at each step anyway. */
#define LENGTHEN_BELOW 2e-3
#define LENGTHEN_BELOW_NONLINEAR 0.1
#define AIMED_ERROR 0.2
/* Of a step for which Newton's method has not converged; at most MAX_TRIES for a step. */
#define RETRY_FACTOR 0.3
#define MAX_TRIES 200
/* Part of the time left to separation that a step takes at most under a nonlinear law. A force like x^1.5 has no Taylor
   series there: steps get shorter, down to the first one's length. */
#define SEPARATION_FRACTION 0.6
/* Permitted error of a joint's demand, relative to its torque limit. */
#define ERROR_OF_LIMIT 1e-2
/* Permitted error of a target's switch by position, relative to other errors. A position that changes slowly passes its
   switch too late by it: without the factor, a board bent slowly to its break was off by 1.1e-5. */
#define ERROR_OF_SWITCH 0.1

/* Law and target linearized where the step begins, and the inverse of I - g dz'/dz. */
typedef struct {
  double force, k, d;              /* force, and its slopes by penetration and rate */
  double rates[NZ1];               /* dz/dt at the begin */
  double Z[NZ1][NZ1], G[NZ1], at[NZ1]; /* slopes of dz/dt by z and by force; of the velocity by z */
  double inverse[NZ1][NZ1], state_by_force[NZ1], mobility;
  double bare_mobility;            /* inverse mass [1/kg] of hand and target, without servo and damping */
} Contact;

/* X by columns, `rows` by rows. With matrices of gains D is by columns too. */
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

/* Inputs of a stage: remainders of the force, of the target's rates and of its velocity. */
#define NONLINEAR (LAW_NONLINEAR || TARGET_NONLINEAR)
#define INPUTS (1 + (TARGET_NONLINEAR ? NZ + 1 : 0))
typedef double Inputs[NONLINEAR ? TERMS : 1][INPUTS];

/* Coefficients w_j of the step's polynomials; the first is the value at the begin. `speeds` are followed by the hand's
   speed, but for the first coefficient. */
typedef struct {
  vec torque[TERMS][V], deviation[TERMS][V], speeds[TERMS][V], demand[TERMS][V];
  double impulse[TERMS], penetration[TERMS], rate[TERMS], force[TERMS], target[NZ1][TERMS];
} Series;

enum { EVENT_NONE, EVENT_RATE, EVENT_FORCE, EVENT_DEMAND, EVENT_SLIDING, EVENT_SWITCH, EVENT_SEPARATION };

typedef struct {
  double at;
  int kind, number;
} Event;

/* Record of the steps for derivatives: the state at the begin of each, its length, the part of it that was taken, and
   the event that ended it. */
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

/* Root of a polynomial with exactly one sign change, from above to below zero: Newton's method within a bracket. */
static double falling_root(const double *b) {
  double low = 0.0, high = 1.0, t = b[0] / (b[0] - b[STAGES]);
  FOR(tries, 60) {
    double slope;
    const double x = bernstein(b, t, &slope);
    if (x > 0.0) low = t;
    else high = t;
    const double next = t - x / slope;
    /* the error is the square of the last change; where the root lies beyond the bracket that is rounding */
    if (slope < 0.0 && fabs(next - t) <= 1e-10 * fmax(t, 1e-4)) return fmin(fmax(next, low), high);
    t = next > low && next < high ? next : (low + high) / 2;
  }
  return t;
}

/* First place where a polynomial, given by its Bernstein coefficients, falls below zero; above 1: nowhere. It has at
   most as many roots as its coefficients have changes of sign (Lane and Riesenfeld 1981): parts are halved until that
   decides. */
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

/* Maximum of a polynomial on [0, end], and its place; or `most` where that is larger. */
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
  /* Newton's method from the best sample, also from an end: the maximum may lie between it and its neighbour */
  FOR(tries, 5) {
    double slope = 0.0, curvature = 0.0;
    for (int k = STAGES; k >= 1; k--) slope = slope * best + k * c[k];
    for (int k = STAGES; k >= 2; k--) curvature = curvature * best + k * (k - 1) * c[k];
    if (curvature < 0.0) best = fmin(fmax(best - slope / curvature, 0.0), end);
  }
  powers(best, p);
  high = value(w, p);
  if (high <= most) return most;
  *where = best;
  return high;
}
