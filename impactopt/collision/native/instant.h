/* State of the collision in joint space, and the forces in it at one instant; see collision/model.py. */

typedef struct {
  vec torque[V], deviation[V], torque2[V];
  double time, penetration, impulse, peak, impulse2, left_out;
  double target[NZ1];
#if SLIDES
  double sliding[3], sliding2[3]; /* integrals of the friction on the target */
#endif
} State;
#if SLIDES
#define SLIDING(y) (y)->sliding
#define SLIDING2(y) (y)->sliding2
#else
#define SLIDING(y) 0
#define SLIDING2(y) 0
#endif

/* what is constant during a segment of the collision */
typedef struct {
  const Frozen *frozen;
  double hand_speed, until;
  vec kept[V];          /* 1 at the joints, else 0 */
  vec bend[V], led[V];  /* the servo's reference: its acceleration, and what its velocities had gained before */
  vec joint_velocity[V], before[V], feedforward[V], limit[V], viscous[V], coulomb[V];
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
  double coefficient, slip_speed, normal[3], point_velocity[3];
#endif
} Data;

typedef struct {
  vec u[V], demand[V], torque[V], net[V]; /* net: less friction */
  double speed, target_speed, rate;
  int compressing, contact;
} Instant;

INLINE double call(int (*f)(const double **, double **, long long *, double *, int), const double *a,
                   const double *b, const double *c) {
  double out = 0.0;
  const double *in[] = {a, b, c};
  double *to[] = {&out};
  f(in, to, 0, 0, 0);
  return out;
}

/* a plus the first columns of a matrix times x, in two chains of sums */
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

/* u, relative to the servo's reference, and the hand's speed, from integrals of torque, force and friction, and time;
   or from derivatives of them */
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
  FOR(k, 3) FOR(i, V) u[i] -= F->of_point[k][i] * sliding[k];
#endif
  const double speed = u[N / LANES][N % LANES];
  u[V - 1] *= d->kept[V - 1];
  return speed;
}

INLINE void times_matrix(const vec (*m)[V], const vec *x, vec *out) {
  FOR(i, V) out[i] = (vec){0};
  FOR(j, N) FOR(i, V) out[i] += m[j][i] * ((const double *)x)[j];
}

/* the servo's torque from joint velocity and deviation, both less those at contact */
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

/* what of its demand the servo gives, and what the joints get */
INLINE void torques(const Data *d, Instant *now) {
#if SATURATION
  FOR(i, V) now->torque[i] = clipped(now->demand[i], d->limit[i]);
#else
  FOR(i, V) now->torque[i] = now->demand[i];
#endif
#if FRICTION
  FOR(i, V) {
    const vec one = d->kept[0] * 0.0 + 1.0, rate = d->joint_velocity[i] + now->u[i];
    const vec sign = clipped(rate / TRANSITION, one);
    now->net[i] = now->torque[i] - (d->viscous[i] * rate + d->coulomb[i] * sign);
  }
#else
  FOR(i, V) now->net[i] = now->torque[i];
#endif
}

/* friction on the target (3) at a state, under a contact force: see contact/friction.py; without, nothing is set */
INLINE void friction_at(const Data *d, const State *y, double force, double *out) {
#if SLIDES
  const Frozen *F = d->frozen;
  double velocity[3], along = 0.0, square = d->slip_speed * d->slip_speed, slide[3];
  FOR(k, 3) {
    velocity[k] = d->point_velocity[k] + F->e_point[k] * y->time + dot(F->of_point[k], y->torque, V);
    FOR(l, 3) velocity[k] -= F->m_point[k][l] * (d->normal[l] * y->impulse + y->sliding[l]);
  }
  FOR(k, 3) along += d->normal[k] * velocity[k];
  FOR(k, 3) slide[k] = velocity[k] - d->normal[k] * along, square += slide[k] * slide[k];
  const double scale = force * d->coefficient / sqrt(square);
  FOR(k, 3) out[k] = scale * slide[k];
#endif
}

/* velocities, rate of penetration and servo at a state */
INLINE void look(const Data *d, const State *y, Instant *now) {
  AFRESH(d);
  now->speed = velocity(d, y->torque, y->impulse, SLIDING(y), y->time, now->u) + d->hand_speed;
  now->target_speed = call(target_velocity, y->target, d->target, 0);
  now->rate = now->speed - now->target_speed;
#if FREEZES
  FOR(i, V) now->u[i] += d->before[i];
#endif
  servo(d, now->u, y->deviation, now->demand);
#if FEEDFORWARD
  FOR(i, V) now->demand[i] += d->feedforward[i];
#endif
  torques(d, now);
}

/* no number in, none out */
static void no_number(const Data *d, State *y, Instant *now) {
  if (now->rate == now->rate) return;
  y->impulse = y->time = y->penetration = y->peak = y->left_out = NAN;
  FOR(i, V) y->torque[i] = y->torque2[i] = (vec){0} + NAN;
  FOR(i, NZ) y->target[i] = NAN;
  y->impulse2 = NAN;
  look(d, y, now);
  now->contact = 1;
}

/* whether hand and target, which neither approach nor part, are about to approach */
static int closing(const Data *d, const State *y, const Instant *now) {
  vec u[V];
  double rates[NZ1], then[NZ1], force;
  force = call(contact_force, &y->penetration, &now->rate, d->law);
  const double *in[] = {y->target, &force, d->target};
  double *out[] = {rates};
  target_rates(in, out, 0, 0, 0);
  FOR(i, NZ) then[i] = y->target[i] + 1e-9 * rates[i];
  const double gained = (call(target_velocity, then, d->target, 0) - now->target_speed) / 1e-9;
  double friction[3];
  friction_at(d, y, force, friction);
  return velocity(d, now->net, force, friction, 1.0, u) > gained;
}

/* phase: contact is over when, in restitution, no force is left */
INLINE void judge(const Data *d, const State *y, Instant *now) {
  now->compressing = now->rate > 0.0 || (now->rate == 0.0 && closing(d, y, now));
  now->contact = now->compressing || call(left_force, &y->penetration, &now->rate, d->law) > 0.0;
}
