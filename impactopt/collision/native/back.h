/* Derivatives of one output by what is frozen, step by step backwards. Where a state or a vector is meant that
   holds derivatives by a state's or a vector's parts, its name ends with _. */

typedef struct {
  vec Q[N + 1][V], drift[V], joint_velocity[V];
  double hand_speed;
} Back;

/* from the servo's torque back to velocity (added), and deviation */
INLINE void back_of_servo(const Data *d, const vec *demand_, vec *u_, vec *deviation_) {
#if KD_MATRIX
  FOR(j, N) ((double *)u_)[j] -= dot(d->kd[j], demand_, V);
#else
  FOR(i, V) u_[i] -= d->kd[i] * demand_[i];
#endif
#if STIFFNESS
#if KP_MATRIX
  FOR(i, V) deviation_[i] = (vec){0};
  FOR(j, N) ((double *)deviation_)[j] = dot(d->kp[j], demand_, V);
#else
  FOR(i, V) deviation_[i] = d->kp[i] * demand_[i];
#endif
#endif
}

INLINE void put_speed(vec *u_, double speed_) { u_[N / LANES][N % LANES] = speed_; }

/* from velocity and hand speed back to the integral of the torque (added), and minus that of the force */
INLINE double back_of_velocity(const Data *d, const vec *u_, vec *torque_) {
  const Frozen *F = d->frozen;
  vec a[V];
  FOR(i, V) a[i] = torque_[i];
  add_columns(F->Q, N + 1, (const double *)u_, a);
  const double force = a[N / LANES][N % LANES];
  FOR(i, V) torque_[i] = a[i] * d->kept[i];
  return force;
}
