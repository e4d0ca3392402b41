/* Adjoint of the loop over steps of constant length; see steps.h. */

/* From derivatives by the final state to derivatives by the frozen model. */
static void run_adjoint(const Data *d, const Tape *tape, State *y_, FrozenAdjoint *all) {
  for (int i = tape->made - 1; i >= 0; i--) step_adjoint(d, &tape->states[i], y_, all);
}
