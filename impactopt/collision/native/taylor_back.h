/* Taylor's steps backwards: the discrete adjoint, for phases and searches' results that stay as they are.

   A name with _ is the derivative of the output by what has that name. */

#define BACK_OF_SCALARS(k, speed) do { \
    const double speed_in_ = (speed); \
    const double *in_[] = {&speed_in_, &compressing, &y->penetration, j.rates, j.forces, j.target, d->law, \
                           d->target, &rates_[k], &forces_[k], next_}; \
    double by_rates_[SIZE], by_forces_[SIZE], by_target_[NZ1 * SIZE], by_x_; \
    double *out_[] = {&speed_, &by_x_, by_rates_, by_forces_, by_target_}; \
    FOR(i, NZ) next_[i] = target_[i * SIZE + (k + 1) % SIZE]; \
    order_##k##_back(in_, out_, 0, 0, 0); \
    x_ += by_x_; \
    FOR(i, k) rates_[i] += by_rates_[i], forces_[i] += by_forces_[i]; \
    FOR(i, NZ) FOR(l, k + 1) target_[i * SIZE + l] += by_target_[i * SIZE + l]; \
  } while (0)

/* from net_k = T[k + 1] back to U[k], U[k - 1], and by the inverse inertia on to T[k] and the force */
#define BACK_OF_VECTORS(k) do { \
    BACK_OF_SCALARS(k, 0.0); \
    vec deviation_[V]; \
    FOR(i, V) { \
      vec net_ = T_[k + 1][i]; \
      BACK_OF_FRICTION(k) \
      D_[k][i] += SATURATION ? (vec)((bits)net_ & free_[i]) : net_; \
    } \
    back_of_servo(d, D_[k], U_[k], deviation_); \
    if (STIFFNESS) FOR(i, V) U_[k - 1][i] -= deviation_[i]; \
    put_speed(U_[k], speed_); \
    forces_[k - 1] -= back_of_velocity(d, U_[k], T_[k]); \
  } while (0)
#if FRICTION
#define BACK_OF_FRICTION(k) U_[k][i] += J_[k][i] - slope[i] * net_;
#else
#define BACK_OF_FRICTION(k)
#endif

/* one step back: `y_` goes from the state after it to the one before it, y */
static void step_back(const Data *d, const State *y, int moves, State *y_, Back *all) {
  Instant now;
  Jets j;
  Event e;
  look(d, y, &now);
  judge(d, y, &now);
  make_jets(d, y, &now, &j);
  const double left = d->until - y->time, length = fmin(LENGTH, left);
  double h = 0.0;
  if (moves) find_event(d, &now, &j, length, &e), h = length_of(&e, length);

  /* from the polynomials' values back to their coefficients, and to their length */
  vec T_[SIZE][V], U_[ORDER][V], D_[ORDER][V], by_h = {0};
#if FRICTION
  vec J_[ORDER][V];
#endif
  double rates_[SIZE] = {0}, forces_[SIZE] = {0}, target_[NZ1 * SIZE] = {0}, next_[NZ1], speed_, power[SIZE + 1];
  double x_ = y_->penetration, time_ = y_->time, h_ = y_->time;
  power[0] = 1.0;
  FOR(k, SIZE) power[k + 1] = power[k] * h / (k + 1);
  FOR(i, V) {
    FOR(k, SIZE) T_[k][i] = y_->torque[i] * power[k];
    vec rate = j.T[1][i];
    for (int k = 2; k < SIZE; k++) rate += j.T[k][i] * power[k - 1];
    by_h += y_->torque[i] * rate;
    FOR(k, ORDER) D_[k][i] = (vec){0};
#if FRICTION
    FOR(k, ORDER) J_[k][i] = (vec){0};
#endif
#if STIFFNESS
    FOR(k, ORDER) U_[k][i] = -y_->deviation[i] * power[k + 1];
    rate = j.U[0][i];
    for (int k = 1; k < ORDER; k++) rate += j.U[k][i] * power[k];
    by_h -= y_->deviation[i] * rate;
#else
    FOR(k, ORDER) U_[k][i] = (vec){0};
#endif
  }
  h_ += sum(by_h);
  FOR(k, ORDER) {
    forces_[k] = y_->impulse * power[k + 1];
    rates_[k] = y_->penetration * power[k + 1];
    h_ += (y_->impulse * j.forces[k] + y_->penetration * j.rates[k]) * power[k];
  }
  FOR(i, NZ) FOR(k, SIZE) {
    target_[i * SIZE + k] = y_->target[i] * power[k];
    if (k) h_ += y_->target[i] * j.target[i * SIZE + k] * power[k - 1];
  }
#if PEAK
  const double top = top_of(j.forces, h); /* it stays where it is: there the force has no slope */
  if (y->peak < value_at(j.forces, SIZE, top)) {
    double by = y_->peak;
    FOR(k, SIZE) forces_[k] += by, by *= top / (k + 1);
    y_->peak = 0.0;
  }
#endif

  /* from the length back to the event, as Newton's last iteration has it */
  if (moves) {
    double length_ = h_;
    if (e.found) {
      const double value = value_at(e.jet, SIZE, e.first), s = value_at(e.jet + 1, SIZE - 1, e.first);
      const double slope = s == 0.0 ? 1.0 : s, t = e.first - value / slope;
      if ((t < 0.0 ? 0.0 : t) + BEYOND * length <= length) {
        length_ = BEYOND * h_;
        double by_jet[SIZE], p = 1.0, before = 0.0;
        FOR(k, SIZE) {
          by_jet[k] = t < 0.0 ? 0.0 : h_ * e.side * (-p / slope + (s == 0.0 ? 0.0 : value * before / (s * s)));
          before = p;
          p = p * e.first / (k + 1);
        }
        if (e.kind == OF_RATE) FOR(k, SIZE) rates_[k] += by_jet[k];
        if (e.kind == OF_FORCE) FOR(k, SIZE) forces_[k] += by_jet[k];
        if (e.kind == OF_DEMAND) FOR(k, ORDER) ((double *)D_[k])[e.joint] += by_jet[k];
#if FRICTION
        if (e.kind == OF_SLIDING) FOR(k, ORDER) ((double *)J_[k])[e.joint] += by_jet[k];
#endif
#if SWITCHES
        if (e.kind == OF_SWITCH) {
          double seeds[SWITCHES * SIZE] = {0}, by_forces[SIZE], by_target[NZ1 * SIZE];
          FOR(k, SIZE) seeds[e.joint * SIZE + k] = by_jet[k];
          const double *in[] = {j.forces, j.target, d->target, seeds};
          double *out[] = {by_forces, by_target};
          switches_back(in, out, 0, 0, 0);
          FOR(k, SIZE) forces_[k] += by_forces[k];
          FOR(k, NZ * SIZE) target_[k] += by_target[k];
        }
#endif
      }
    }
    if (left < LENGTH) time_ -= length_;
  }

  /* order by order, last first */
  const double compressing = now.compressing;
  bits free_[V];
  FOR(i, V) free_[i] = now.torque[i] == now.demand[i];
#if FRICTION
  vec slope[V];
  FOR(i, V) {
    const bits sliding = magnitude(j.J[0][i]) > TRANSITION;
    slope[i] = d->viscous[i] + choose(sliding, (vec){0}, d->coulomb[i] / TRANSITION);
  }
#endif
  if (rates_[6] != 0.0 || forces_[6] != 0.0) {
    const Frozen *F = d->frozen;
    BACK_OF_SCALARS(6, 0.0);
    FOR(i, V) T_[6][i] += speed_ * F->Q[N][i] * d->kept[i];
    forces_[5] -= speed_ * ((const double *)F->Q[N])[N];
    FOR(i, V) all->Q[N][i] += speed_ * j.T[6][i];
    ((double *)all->Q[N])[N] -= speed_ * j.forces[5];
  }
  BACK_OF_VECTORS(5);
  BACK_OF_VECTORS(4);
  BACK_OF_VECTORS(3);
  BACK_OF_VECTORS(2);
  BACK_OF_VECTORS(1);
  BACK_OF_SCALARS(0, now.speed);
  FOR(i, V) {
    const vec net_ = T_[1][i];
#if FRICTION
    const vec by_rate = J_[0][i] - slope[i] * net_;
    U_[0][i] += by_rate;
    all->joint_velocity[i] += by_rate;
#endif
    D_[0][i] += SATURATION ? (vec)((bits)net_ & free_[i]) : net_;
  }
  vec deviation_[V];
  back_of_servo(d, D_[0], U_[0], deviation_);
  if (STIFFNESS) FOR(i, V) y_->deviation[i] += deviation_[i];
  put_speed(U_[0], speed_);
  y_->impulse -= back_of_velocity(d, U_[0], T_[0]);
#if BIAS || JDOT
  time_ += dot(d->frozen->drift, U_[0], V);
  FOR(i, V) all->drift[i] += y->time * U_[0][i] + U_[1][i];
#endif
  all->hand_speed += speed_;
  FOR(i, V) y_->torque[i] = T_[0][i];
  y_->penetration = x_;
  y_->time = time_;
  FOR(i, NZ) y_->target[i] = target_[i * SIZE];

  /* the products' matrix, all orders at once */
  FOR(c, N + 1) {
    vec s[V];
    FOR(i, V) s[i] = all->Q[c][i];
    FOR(k, ORDER) {
      const double x = c < N ? ((const double *)j.T[k])[c] : (k ? -j.forces[k - 1] : -y->impulse);
      FOR(i, V) s[i] += U_[k][i] * x;
    }
    FOR(i, V) all->Q[c][i] = s[i];
  }
}
