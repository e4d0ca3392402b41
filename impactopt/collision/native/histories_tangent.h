/* Tangents of the histories; see histories.h. */

/* Destination of each output's derivatives by each direction; null where they are not requested. */
typedef struct {
  double *to[N_VALUES][ALL_VECTORS * LANES];
} RecordTangent;

#if FRICTION || defined(OUT_joint_velocity)
#define SPEEDS_OF_COLUMNS 1
#else
#define SPEEDS_OF_COLUMNS 0
#endif

/* Entries of a wrench that are needed: for a ZMP alone the vertical force and two moments. */
#if defined(OUT_zmp) && !defined(OUT_ground_wrench) && !HELD_ASKED
#define ROWS_ASKED(i) for (int i = 2; i < 5; i++)
#else
#define ROWS_ASKED(i) FOR(i, SIX)
#endif

/* An instant, and the values that tangents there depend on. */
typedef struct {
  int number;
  StepPoint place;
  Instant at;
  Contact contact;
  double force, ground[SIX];
} Column;

static void column_of(const Data *d, double penetration, Column *c) {
  c->force = call(contact_force, &penetration, &c->at.rate, d->law);
#ifdef OUT_zmp
  vec wrench[VC];
  wrench_of(d->frozen, (const double *)c->at.net, c->force, 0, 1.0, wrench);
  ground_wrench_of(d->frozen, (const double *)wrench, c->ground);
#endif
}

/* Writes rows of a vector of directions to the output of each direction. */
typedef vec unaligned_vec __attribute__((aligned(8)));
INLINE void write_entries(const vec *x, int rows, long place, double *const *to) {
  if (rows < LANES) {
    FOR(l, LANES) if (to[l]) FOR(i, rows) to[l][place + i] = x[i][l];
    return;
  }
  /* the last square overlaps the one before */
  for (int begin = 0; begin < rows; begin += LANES) {
    const int i = begin + LANES <= rows ? begin : rows - LANES;
    vec square[LANES];
    FOR(a, LANES) square[a] = x[i + a];
    transpose(square);
    FOR(l, LANES) if (to[l]) *(unaligned_vec *)(to[l] + place + i) = square[l];
  }
}
#define PUT(name, rows, x) write_entries(x, rows, (long)(rows) * c->number, record->to[OUT_##name] + k * LANES)

static void write_tangent(const Data *d, const FrozenTangent *t, int k, const Column *c, const StateTangent *x,
                          const RecordTangent *record) {
#ifdef OUT_time
  PUT(time, 1, &x->time);
#endif
#ifdef OUT_penetration
  PUT(penetration, 1, &x->penetration);
#endif
#ifdef OUT_hand_speed
  const vec speed = x->rate + x->target_speed;
  PUT(hand_speed, 1, &speed);
#endif
#ifdef OUT_target_speed
  PUT(target_speed, 1, &x->target_speed);
#endif
#ifdef OUT_force
  PUT(force, 1, &x->force);
#endif
#ifdef OUT_joint_velocity
  vec velocity[N1];
  memcpy(velocity, x->speeds, sizeof velocity);
  FOR(i, N) add_to_direction(&velocity[i], k, FIRST_OF(BY_V) + NV - N + i, 1.0);
#if REFERENCE
  FOR(i, N) velocity[i] += ((const double *)d->reference_acceleration)[i] * x->time;
#endif
  PUT(joint_velocity, N, velocity);
#endif
#ifdef OUT_demand
  PUT(demand, N, x->demand);
#endif
#if defined(OUT_torque) || HELD_HISTORY
  /* net torques and, last, minus the hand's force: wrenches are linear in these */
  vec net[N + 1];
  FOR(i, N) {
    const double held = ((const double *)c->at.torque)[i] == ((const double *)c->at.demand)[i];
    net[i] = held * x->demand[i];
  }
#endif
#ifdef OUT_torque
  PUT(torque, N, net);
#endif
#if HELD_HISTORY
#if FRICTION
  FOR(i, N) {
    const double rate = ((const double *)d->joint_velocity)[i] + ((const double *)c->at.u)[i];
    double slope = ((const double *)d->viscous)[i];
    if (fabs(rate) <= TRANSITION) slope += ((const double *)d->coulomb)[i] / TRANSITION;
    net[i] -= slope * x->speeds[i];
    add_to_direction(&net[i], k, FIRST_OF(BY_V) + NV - N + i, -slope);
  }
#endif
  net[N] = -x->force;
  vec wrenches[WRENCHES_ASKED][SIX];
  FOR(g, WRENCHES_ASKED) {
    vec sum[SIX];
    memcpy(sum, t->wrench_begin[k][g], sizeof sum);
    FOR(j, N + 1) ROWS_ASKED(i) sum[i] -= t->by[g][j][i] * net[j];
    if (k < VECTORS_OF_Q) {
      const vec(*by)[SIX] = t->wrench_by[k][g];
      FOR(j, N) ROWS_ASKED(i) sum[i] -= ((const double *)c->at.net)[j] * by[j][i];
      ROWS_ASKED(i) sum[i] += c->force * by[N][i];
    }
    memcpy(wrenches[g], sum, sizeof sum);
  }
#ifdef OUT_sole_wrench
  PUT(sole_wrench, SIX * SOLES, wrenches[0]);
#endif
#ifdef OUT_hand_wrench
  PUT(hand_wrench, C - SIX * SOLES, wrenches[SOLES]);
#endif
#ifdef OUT_ground_wrench
  PUT(ground_wrench, SIX, wrenches[WRENCHES_ASKED - 1]);
#endif
#ifdef OUT_zmp
  const double *sum = c->ground;
  const vec *total = wrenches[WRENCHES_ASKED - 1];
  const vec place[2] = {(-total[4] + sum[4] / sum[2] * total[2]) / sum[2],
      (total[3] - sum[3] / sum[2] * total[2]) / sum[2]};
  PUT(zmp, 2, place);
#endif
#endif
}

/* Prefetches the memory of the next columns: the outputs do not fit into a cache. */
static void prefetch(const RecordTangent *record, int k, int column, int count) {
  FOR(i, N_VALUES) if (ROWS[i]) FOR(l, LANES) {
    const char *to = (const char *)record->to[i][k * LANES + l];
    const long begin = (long)ROWS[i] * column * sizeof(double), end = begin + (long)ROWS[i] * count * sizeof(double);
    if (to) for (long place = begin; place < end; place += 64) __builtin_prefetch(to + place, 1);
  }
}

/* Fills the columns after `column` with its values, twice as many at each copy. */
static void repeat_tangent(const RecordTangent *record, int column) {
  FOR(i, N_VALUES) FOR(direction, ALL_VECTORS * LANES) {
    const long rows = ROWS[i], wanted = rows * (N_COLUMNS[0] - column);
    if (!rows || !record->to[i][direction]) continue;
    double *to = record->to[i][direction] + rows * column;
    for (long made = rows; made < wanted; made *= 2)
      memcpy(to + made, to, (made < wanted - made ? made : wanted - made) * sizeof(double));
  }
}
