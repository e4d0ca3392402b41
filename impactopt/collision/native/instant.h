/* State of the collision in joint space, and forces at one instant; see collision/model.py. */

typedef struct {
  vec torque[V], deviation[V], torque2[V];
  double time, penetration, impulse, peak, impulse2, error_estimate;
  double target[NZ1];
#if SLIDES
  double sliding[3], sliding2[3]; /* first and second integral of the friction on the target */
  double bristles[AT_LEAST_1(3 * BRISTLES)]; /* their deflection */
#endif
} State;
#if SLIDES
#define SLIDING(y) (y)->sliding
#define SLIDING2(y) (y)->sliding2
#else
#define SLIDING(y) 0
#define SLIDING2(y) 0
#endif

/* Constants of a segment. */
typedef struct {
  const Frozen *frozen;
  double hand_speed, until;
  vec joint_mask[V];          /* 1 at the joints, 0 in the lanes behind them */
  vec reference_acceleration[V], reference_change[V];  /* of the servo's reference: see freeze_reference */
  vec joint_velocity[V], velocity_before[V], feedforward[V], limit[V], viscous[V], coulomb[V];
#if KD_MATRIX
  vec kd[N1][V];
#else
  vec kd[V];
#endif
#if KP_MATRIX
  vec kp[N1][V];
#else
  vec kp[V];
#endif
  double law[AT_LEAST_1(N_LAW)], target[AT_LEAST_1(N_TARGET)];
#if SLIDES
  double coefficient, slip_speed, stiffness, normal[3], point_velocity[3];
#endif
#if MOVES_TARGET
  double mobility; /* inverse mass of the target across the normal; point_velocity is against its velocity there */
#endif
} Data;

typedef struct {
  vec u[V], demand[V], torque[V], net[V]; /* net: torque less joint friction */
  double speed, target_speed, rate;
  int compressing, contact;
} Instant;

INLINE double call(int (*f)(const double **, double **, long long *, double *, int), const double *a, const double *b,
                   const double *c) {
  double out = 0.0;
  const double *in[] = {a, b, c};
  double *to[] = {&out};
  f(in, to, 0, 0, 0);
  return out;
}

/* a += M x, over M's first columns. Two chains of sums, as one would wait for each addition. */
INLINE void add_columns(const vec (*M)[V], int columns, const double *x, vec *a) {
  vec b[V];
  FOR(i, V) b[i] = (vec){0};
#pragma GCC unroll 16
  for (int j = 0; j + 1 < columns; j += 2) {
    FOR(i, V) a[i] += M[j][i] * x[j];
    FOR(i, V) b[i] += M[j + 1][i] * x[j + 1];
  }
  if (columns % 2) FOR(i, V) a[i] += M[columns - 1][i] * x[columns - 1];
  FOR(i, V) a[i] += b[i];
}

/* Joint velocities u relative to the servo's reference, and the hand's speed (returned), both as changes since the
   freeze, from the integrals of torque, force and friction, and time. Linear: rates of the integrals give
   accelerations. */
INLINE double velocity(const Data *d, const vec *torque, double impulse, const double *sliding, double time, vec *u) {
  const Frozen *F = d->frozen;
  AFRESH(F);
  vec a[V];
#if BIAS || JDOT
  FOR(i, V) a[i] = F->drift[i] * time;
#else
  FOR(i, V) a[i] = (vec){0};
#endif
  add_columns(F->Q, N, (const double *)torque, a);
  FOR(i, V) u[i] = a[i] - F->Q[N][i] * impulse;
#if SLIDES
  FOR(k, 3) FOR(i, V) u[i] -= F->Q_point[k][i] * sliding[k];
#endif
  const double speed = u[N / LANES][N % LANES];
  u[V - 1] *= d->joint_mask[V - 1];
  return speed;
}

INLINE void times_matrix(const vec (*m)[V], const vec *x, vec *out) {
  FOR(i, V) out[i] = (vec){0};
  FOR(j, N) FOR(i, V) out[i] += m[j][i] * ((const double *)x)[j];
}

/* Servo torque from the changes of joint velocity and deviation since contact. */
INLINE void servo(const Data *d, const vec *u, const vec *deviation, vec *out) {
#if KD_MATRIX
  times_matrix(d->kd, u, out);
  FOR(i, V) out[i] = -out[i];
#else
  FOR(i, V) out[i] = -(d->kd[i] * u[i]);
#endif
#if STIFFNESS
#if KP_MATRIX
  vec held[V];
  times_matrix(d->kp, deviation, held);
  FOR(i, V) out[i] += held[i];
#else
  FOR(i, V) out[i] += d->kp[i] * deviation[i];
#endif
#endif
}

INLINE vec clipped(vec x, vec limit) { return choose(x > limit, limit, choose(x < -limit, -limit, x)); }
INLINE vec magnitude(vec x) { return (vec)((bits)x & ~SIGN_BIT); }

/* Torques of saturated servos, and less joint friction. */
INLINE void torques(const Data *d, Instant *now) {
#if SATURATION
  FOR(i, V) now->torque[i] = clipped(now->demand[i], d->limit[i]);
#else
  FOR(i, V) now->torque[i] = now->demand[i];
#endif
#if FRICTION
  FOR(i, V) {
    const vec one = d->joint_mask[0] * 0.0 + 1.0, rate = d->joint_velocity[i] + now->u[i];
    const vec sign = clipped(rate / TRANSITION, one);
    now->net[i] = now->torque[i] - (d->viscous[i] * rate + d->coulomb[i] * sign);
  }
#else
  FOR(i, V) now->net[i] = now->torque[i];
#endif
}

/* Friction on the target (3) under a contact force, and rate of the bristles' deflection (3); see contact/friction.py.
   Sets nothing in models without friction, nor `rate` without bristles. */
INLINE void friction_at(const Data *d, const State *y, double force, double *out, double *rate) {
#if SLIDES
  const Frozen *F = d->frozen;
  double velocity[3], along = 0.0, square = d->slip_speed * d->slip_speed, slide[3];
  FOR(k, 3) {
    velocity[k] = d->point_velocity[k] + F->e_point[k] * y->time + dot(F->Q_point[k], y->torque, V);
    FOR(l, 3) velocity[k] -= F->m_point[k][l] * (d->normal[l] * y->impulse + y->sliding[l]);
#if MOVES_TARGET
    velocity[k] -= d->mobility * y->sliding[k];
#endif
  }
  FOR(k, 3) along += d->normal[k] * velocity[k];
  FOR(k, 3) slide[k] = velocity[k] - d->normal[k] * along, square += slide[k] * slide[k];
#if BRISTLES
  double length = TINY * TINY;
  FOR(k, 3) length += y->bristles[k] * y->bristles[k];
  const double limit = force * d->coefficient, elastic = d->stiffness * sqrt(length);
  const double lean = d->stiffness / (limit > elastic ? limit : elastic);
  FOR(k, 3) out[k] = limit * lean * y->bristles[k];
  FOR(k, 3) rate[k] = slide[k] - sqrt(square) * lean * y->bristles[k];
#else
  const double scale = force * d->coefficient / sqrt(square);
  FOR(k, 3) out[k] = scale * slide[k];
#endif
#endif
}

/* Velocities, rate of penetration and servo torques at a state. */
INLINE void evaluate_instant(const Data *d, const State *y, Instant *now) {
  AFRESH(d);
  now->speed = velocity(d, y->torque, y->impulse, SLIDING(y), y->time, now->u) + d->hand_speed;
  now->target_speed = call(target_velocity, y->target, d->target, 0);
  now->rate = now->speed - now->target_speed;
#if FREEZES
  FOR(i, V) now->u[i] += d->velocity_before[i];
#endif
  servo(d, now->u, y->deviation, now->demand);
#if FEEDFORWARD
  FOR(i, V) now->demand[i] += d->feedforward[i];
#endif
  torques(d, now);
}

/* A NaN in the rate of penetration makes the whole state NaN: no output may look like a number. */
static void spread_nan(const Data *d, State *y, Instant *now) {
  if (now->rate == now->rate) return;
  y->impulse = y->time = y->penetration = y->peak = y->error_estimate = NAN;
  FOR(i, V) y->torque[i] = y->torque2[i] = (vec){0} + NAN;
  FOR(i, NZ) y->target[i] = NAN;
  y->impulse2 = NAN;
  evaluate_instant(d, y, now);
  now->contact = 1;
}

/* Whether hand and target are about to approach, where their relative speed is zero. */
static int will_approach(const Data *d, const State *y, const Instant *now) {
  vec u[V];
  double rates[NZ1], then[NZ1], force;
  force = call(contact_force, &y->penetration, &now->rate, d->law);
  const double *in[] = {y->target, &force, d->target};
  double *out[] = {rates};
  target_rates(in, out, 0, 0, 0);
  FOR(i, NZ) then[i] = y->target[i] + 1e-9 * rates[i];
  const double gained = (call(target_velocity, then, d->target, 0) - now->target_speed) / 1e-9;
  double friction[3], rate[3];
  friction_at(d, y, force, friction, rate);
  return velocity(d, now->net, force, friction, 1.0, u) > gained;
}

/* Phase of the contact: it ends in restitution, where no force is left. */
INLINE void update_phase(const Data *d, const State *y, Instant *now) {
  now->compressing = now->rate > 0.0 || (now->rate == 0.0 && will_approach(d, y, now));
  now->contact = now->compressing || call(left_force, &y->penetration, &now->rate, d->law) > 0.0;
}
