/* Tangents of the histories, a column an instant; see outputs.h. */

typedef struct {
  double **by[KINDS]; /* where each output's derivatives go: a column a direction, with the output column by column */
} RecordTangent;

#if FRICTION || defined(OUT_joint_velocity)
#define SPEEDS_OF_COLUMNS 1
#else
#define SPEEDS_OF_COLUMNS 0
#endif

/* of a state, and what one sees of it; in columns, of speeds only those that are asked for, and the hand's */
typedef struct {
  vec speeds[ROWS_OF_V][VD], demand[N1][VD], target[NZ1][VD];
  vec impulse[VD], penetration[VD], time[VD], peak[VD], rate[VD], force[VD], target_speed[VD];
} StateTangent;

INLINE void put(const vec (*x)[VD], int seeds, int rows, int columns, int column, double *to) {
  FOR(seed, seeds) FOR(i, rows) to[(long)seed * rows * columns + (long)rows * column + i] = ((const double *)x[i])[seed];
}
#define PUT(name, rows, x) \
  if (by[OUT_##name]) put((const vec(*)[VD])(x), SEEDS(kind), rows, N_COLUMNS[0], column, by[OUT_##name])

static void write_tangent(const Data *d, const FrozenTangent *t, const Frozen *F, const vec (*P)[V], int kind,
                          const Instant *at, double force, const StateTangent *x, const RecordTangent *record,
                          int column) {
  double **by = record->by[kind];
#ifdef OUT_time
  PUT(time, 1, x->time);
#endif
#ifdef OUT_penetration
  PUT(penetration, 1, x->penetration);
#endif
#ifdef OUT_hand_speed
  vec speed[1][VD];
  FOR_EACH(k) speed[0][k] = x->rate[k] + x->target_speed[k];
  PUT(hand_speed, 1, speed);
#endif
#ifdef OUT_target_speed
  PUT(target_speed, 1, x->target_speed);
#endif
#ifdef OUT_force
  PUT(force, 1, x->force);
#endif
#ifdef OUT_joint_velocity
  vec velocity[N1][VD];
  memcpy(velocity, x->speeds, sizeof velocity);
  if (kind == BY_V) FOR(i, N) *lane(velocity[i], NV - N + i) += 1.0;
#if REFERENCE
  FOR(i, N) FOR_EACH(k) velocity[i][k] += ((const double *)d->bend)[i] * x->time[k];
#endif
  PUT(joint_velocity, N, velocity);
#endif
#ifdef OUT_demand
  PUT(demand, N, x->demand);
#endif
#if defined(OUT_torque) || HELD_HISTORY
  /* with the hand's force, negative, in the last row: what wrenches are of */
  vec net[N + 1][VD];
  FOR(i, N) {
    const int held = ((const double *)at->torque)[i] == ((const double *)at->demand)[i];
    FOR_EACH(k) net[i][k] = either(held, x->demand[i][k], (vec){0});
  }
#endif
#ifdef OUT_torque
  PUT(torque, N, net);
#endif
#if HELD_HISTORY
#if FRICTION
  FOR(i, N) {
    const double rate = ((const double *)d->joint_velocity)[i] + ((const double *)at->u)[i];
    double slope = ((const double *)d->viscous)[i];
    if (fabs(rate) <= TRANSITION) slope += ((const double *)d->coulomb)[i] / TRANSITION;
    FOR_EACH(k) net[i][k] -= slope * x->speeds[i][k];
    if (kind == BY_V) *lane(net[i], NV - N + i) -= slope;
  }
#endif
  FOR_EACH(k) net[N][k] = -x->force[k];
  vec held[C1][VD];
  FOR(c, C) {
    FOR_EACH(k) held[c][k] = t->L_0[kind][c][k];
    FOR(j, N + 1) FOR_EACH(k) held[c][k] -= ((const double *)P[c])[j] * net[j][k];
    if (kind == BY_Q) FOR(j, N + 1) {
      const double of = j < N ? ((const double *)at->net)[j] : -force;
      FOR_EACH(k) held[c][k] -= of * t->P[c][j][k];
    }
  }
#ifdef OUT_sole_wrench
  PUT(sole_wrench, 6 * SOLES, held);
#endif
#ifdef OUT_hand_wrench
  PUT(hand_wrench, C - 6 * SOLES, held + 6 * SOLES);
#endif
#if defined(OUT_ground_wrench) || defined(OUT_zmp)
  vec wrench[VC], total[6][VD];
  wrench_of(F, (const double *)at->net, force, 1.0, wrench);
  memcpy(total, t->unmodelled[kind], sizeof total);
  FOR(s, SOLES) {
    const double *f = (const double *)wrench + 6 * s, *p = F->soles + 3 * s;
    const vec(*df)[VD] = (const vec(*)[VD])held + 6 * s, (*dp)[VD] = t->soles + 3 * s;
    FOR_EACH(k) {
      FOR(i, 6) total[i][k] += df[i][k];
      FOR(i, 3) {
        const int a = (i + 1) % 3, b = (i + 2) % 3;
        total[3 + i][k] += p[a] * df[b][k] - p[b] * df[a][k];
        if (kind == BY_Q) total[3 + i][k] += dp[a][k] * f[b] - dp[b][k] * f[a];
      }
    }
  }
#endif
#ifdef OUT_ground_wrench
  PUT(ground_wrench, 6, total);
#endif
#ifdef OUT_zmp
  double sum[6];
  ground_wrench_of(F, (const double *)wrench, sum);
  vec place[2][VD];
  FOR_EACH(k) {
    place[0][k] = (-total[4][k] + sum[4] / sum[2] * total[2][k]) / sum[2];
    place[1][k] = (total[3][k] - sum[3] / sum[2] * total[2][k]) / sum[2];
  }
  PUT(zmp, 2, place);
#endif
#endif
}

/* the columns after `column` repeat it */
static void repeat_tangent(const RecordTangent *record, int column) {
  FOR(kind, KINDS) FOR(i, N_VALUES) {
    const long rows = ROWS[i], size = rows * N_COLUMNS[0];
    double *to = record->by[kind][i];
    if (!rows || !to) continue;
    FOR(seed, SEEDS(kind)) for (int k = column + 1; k < N_COLUMNS[0]; k++)
      memcpy(to + seed * size + rows * k, to + seed * size + rows * column, rows * sizeof(double));
  }
}
