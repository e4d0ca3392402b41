/* Taylor steps that end on events; see collision/taylor.py and events.py, which this follows line by line. */

static const double INVERSE_FACTORIAL[] = {1.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720};

INLINE double value_at(const double *jet, int size, double t) {
  double value = jet[size - 1] * INVERSE_FACTORIAL[size - 1];
  for (int k = size - 2; k >= 0; k--) value = value * t + jet[k] * INVERSE_FACTORIAL[k];
  return value;
}
INLINE vec vector_at(const vec (*jet)[V], int i, int size, double t) {
  vec value = jet[size - 1][i] * INVERSE_FACTORIAL[size - 1];
  for (int k = size - 2; k >= 0; k--) value = value * t + jet[k][i] * INVERSE_FACTORIAL[k];
  return value;
}
INLINE double newton(const double *jet, int size, double t) {
  const double value = value_at(jet, size, t), slope = value_at(jet + 1, size - 1, t);
  return t - value / (slope == 0.0 ? 1.0 : slope);
}

/* where within a step the force is largest; at the begin, where that is at an end: the next step begins there */
INLINE double top_of(const double *forces, double h) {
  const double rise = forces[1], fall = value_at(forces + 1, ORDER, h);
  if (!(rise > 0.0 && fall < 0.0)) return 0.0;
  double t = h * rise / (rise - fall);
  FOR(k, 3) {
    t = newton(forces + 1, ORDER, t);
    t = t < 0.0 ? 0.0 : t;
    t = t > h ? h : t;
  }
  return t;
}

typedef struct {
  double first;
  int found;
  double jet[SIZE]; /* that crosses zero first, padded with zeros */
  int kind, joint;
  double side;
} Event;
enum { OF_RATE, OF_FORCE, OF_DEMAND, OF_SLIDING, OF_SWITCH };

static void look_at(const double *jet, int size, double length, int kind, int joint, double side, Event *e) {
  const double end = value_at(jet, size, length);
  if (!(jet[0] * end < 0.0)) return;
  double t = length * jet[0] / (jet[0] - end);
  FOR(k, 2) {
    t = newton(jet, size, t);
    t = t < 0.0 ? 0.0 : t;
    t = t > length ? length : t;
  }
  if (!(t < e->first)) return;
  *e = (Event){.first = t, .found = 1, .kind = kind, .joint = joint, .side = side};
  FOR(k, size) e->jet[k] = jet[k];
}

/* whether |value| crosses its level by the end, a joint a lane; `side` gets the sign bit of the side it is on */
INLINE bits crosses_level(const vec (*jet)[V], int i, vec level, double length, bits *side) {
  vec more = jet[ORDER - 1][i] * INVERSE_FACTORIAL[ORDER - 1];
  for (int k = ORDER - 2; k >= 1; k--) more = more * length + jet[k][i] * INVERSE_FACTORIAL[k];
  const vec start = jet[0][i], end = more * length + start;
  *side = (bits)choose(magnitude(start) > level, start, end) & SIGN_BIT;
  const vec from = (vec)((bits)start ^ *side) - level, to = (vec)((bits)more ^ *side) * length + from;
  return from * to < 0.0;
}

static void look_at_level(const vec (*jets)[V], int joint, double level, bits side, double length, int kind,
                          Event *e) {
  const double sign = side[joint % LANES] ? -1.0 : 1.0;
  double jet[ORDER];
  FOR(k, ORDER) jet[k] = sign * ((const double *)jets[k])[joint];
  jet[0] -= level;
  look_at(jet, ORDER, length, kind, joint, sign, e);
}

/* one step's jets; T: integral of the torque less friction, U: joint velocity, D: demand, J: joint rates */
typedef struct {
  vec T[SIZE][V], U[ORDER][V], D[ORDER][V];
#if FRICTION
  vec J[ORDER][V];
#endif
  double rates[SIZE], forces[SIZE], target[NZ1 * SIZE], impulse;
} Jets;

#define SCALARS_OF_ORDER(k, speed) do { \
    const double speed_ = speed; \
    double next_[NZ1]; \
    const double *in_[] = {&speed_, &compressing, &y->penetration, j->rates, j->forces, j->target, d->law, d->target}; \
    double *out_[] = {&j->rates[k], &j->forces[k], next_}; \
    order_##k(in_, out_, 0, 0, 0); \
    if (k < ORDER) FOR(i, NZ) j->target[i * SIZE + (k + 1) % SIZE] = next_[i]; \
  } while (0)

#define VECTORS_OF_ORDER(k) do { \
    const double moved_ = velocity(d, j->T[k], j->forces[k - 1], k == 1, j->U[k]); \
    vec deviation_[V]; \
    FOR(i, V) deviation_[i] = -j->U[k - 1][i]; \
    servo(d, j->U[k], deviation_, j->D[k]); \
    FOR(i, V) { \
      vec net_ = j->D[k][i]; \
      if (SATURATION) net_ = (vec)((bits)net_ & free_[i]); \
      WITH_FRICTION(k) \
      j->T[k + 1][i] = net_; \
    } \
    SCALARS_OF_ORDER(k, moved_); \
  } while (0)
#if FRICTION
#define WITH_FRICTION(k) net_ -= slope[i] * j->U[k][i]; j->J[k][i] = j->U[k][i];
#else
#define WITH_FRICTION(k)
#endif

INLINE void make_jets(const Data *d, const State *y, const Instant *now, Jets *j) {
  const double compressing = now->compressing;
  j->impulse = y->impulse;
  FOR(i, NZ) j->target[i * SIZE] = y->target[i];
  bits free_[V];
  FOR(i, V) {
    j->T[0][i] = y->torque[i];
    j->T[1][i] = now->net[i];
    j->U[0][i] = now->u[i];
    j->D[0][i] = now->demand[i];
    free_[i] = now->torque[i] == now->demand[i];
  }
#if FRICTION
  vec slope[V];
  FOR(i, V) {
    j->J[0][i] = d->joint_velocity[i] + now->u[i];
    slope[i] = d->viscous[i] + choose(magnitude(j->J[0][i]) > TRANSITION, (vec){0}, d->coulomb[i] / TRANSITION);
  }
#endif
  SCALARS_OF_ORDER(0, now->speed);
  VECTORS_OF_ORDER(1);
  VECTORS_OF_ORDER(2);
  VECTORS_OF_ORDER(3);
  VECTORS_OF_ORDER(4);
  VECTORS_OF_ORDER(5);
  /* the hand's speed only; the lanes beyond the joints hold no torque */
  const Frozen *F = d->frozen;
  SCALARS_OF_ORDER(6, dot(F->Q[N], j->T[ORDER], V) - ((const double *)F->Q[N])[N] * j->forces[ORDER - 1]);
}

INLINE void find_event(const Data *d, const Instant *now, const Jets *j, double length, Event *e) {
  e->first = length;
  e->found = 0;
  look_at(j->rates, SIZE, length, OF_RATE, 0, 1.0, e);
  if (!now->compressing) look_at(j->forces, SIZE, length, OF_FORCE, 0, 1.0, e);
#if SATURATION || FRICTION
  bits crossed = {0}, of_demand[V], side[V], of_sliding[V], side_of_sliding[V];
  FOR(i, V) {
    of_demand[i] = of_sliding[i] = (bits){0};
#if SATURATION
    crossed |= of_demand[i] = crosses_level(j->D, i, d->limit[i], length, &side[i]);
#endif
#if FRICTION
    crossed |= of_sliding[i] =
        crosses_level(j->J, i, (vec){0} + TRANSITION, length, &side_of_sliding[i]) & (bits)(d->kept[i] > 0.0);
#endif
  }
  if (any(crossed)) {
    FOR(i, N) {
#if SATURATION
      if (of_demand[i / LANES][i % LANES])
        look_at_level(j->D, i, ((const double *)d->limit)[i], side[i / LANES], length, OF_DEMAND, e);
#endif
#if FRICTION
      if (of_sliding[i / LANES][i % LANES])
        look_at_level(j->J, i, TRANSITION, side_of_sliding[i / LANES], length, OF_SLIDING, e);
#endif
    }
  }
#endif
#if SWITCHES
  double jets[SWITCHES * SIZE];
  const double *in[] = {j->forces, j->target, d->target};
  double *out[] = {jets};
  switches(in, out, 0, 0, 0);
  FOR(i, SWITCHES) look_at(jets + i * SIZE, SIZE, length, OF_SWITCH, i, 1.0, e);
#endif
}

INLINE double length_of(const Event *e, double length) {
  if (!e->found) return length;
  double t = newton(e->jet, SIZE, e->first);
  t = (t < 0.0 ? 0.0 : t) + BEYOND * length;
  return t > length ? length : t;
}

INLINE void move(State *y, const Jets *j, double h) {
#if SECOND_INTEGRALS
  FOR(i, V) {
    vec value = j->T[ORDER - 1][i] * INVERSE_FACTORIAL[ORDER];
    for (int k = ORDER - 2; k >= 0; k--) value = value * h + j->T[k][i] * INVERSE_FACTORIAL[k + 1];
    y->torque2[i] += value * h;
  }
  double twice[SIZE + 1] = {y->impulse2, y->impulse};
  FOR(k, ORDER - 1) twice[k + 2] = j->forces[k];
  y->impulse2 = value_at(twice, SIZE, h);
#endif
#if STIFFNESS
  FOR(i, V) {
    vec value = j->U[ORDER - 1][i] * INVERSE_FACTORIAL[ORDER];
    for (int k = ORDER - 2; k >= 0; k--) value = value * h + j->U[k][i] * INVERSE_FACTORIAL[k + 1];
    y->deviation[i] -= value * h;
  }
#endif
  FOR(i, V) y->torque[i] = vector_at(j->T, i, SIZE, h);
  double impulse[SIZE] = {y->impulse}, penetration[SIZE] = {y->penetration};
  FOR(k, ORDER) impulse[k + 1] = j->forces[k], penetration[k + 1] = j->rates[k];
  y->impulse = value_at(impulse, SIZE, h);
  y->penetration = value_at(penetration, SIZE, h);
  FOR(i, NZ) y->target[i] = value_at(j->target + i * SIZE, SIZE, h);
  y->time += h;
#if PEAK
  const double most = value_at(j->forces, SIZE, top_of(j->forces, h));
  y->peak = y->peak < most ? most : y->peak;
#endif
#if STEP_ERROR
  y->left_out += LEFT_OUT_BY_TAYLOR * fabs(j->forces[ORDER]) * pow(h, SIZE);
#endif
}

INLINE void advance(const Data *d, State *y, const Instant *now, double length) {
  Jets j;
  Event e;
  make_jets(d, y, now, &j);
  find_event(d, now, &j, length, &e);
  move(y, &j, length_of(&e, length));
}

/* what a step of no length, after separation, does in the graph: it looks at the force once more */
INLINE void stand_still(const Data *d, State *y, const Instant *now) {
#if PEAK
  if (now->contact) {
    double rate, force, next[NZ1], rates[SIZE], forces[SIZE], target[NZ1 * SIZE] = {0};
    const double compressing = now->compressing;
    FOR(i, NZ) target[i * SIZE] = y->target[i];
    const double *in[] = {&now->speed, &compressing, &y->penetration, rates, forces, target, d->law, d->target};
    double *out[] = {&rate, &force, next};
    order_0(in, out, 0, 0, 0);
    y->peak = y->peak < force ? force : y->peak;
  }
#endif
}
