/* Adjoint of the loop over steps of constant length; see steps.h. */

/* From derivatives by the final state to derivatives by the frozen model. */
static void run_adjoint(const Data *d, const Tape *tape, int in_contact, State *y_, FrozenAdjoint *all) {
  if (tape->made % BLOCK && in_contact) step_adjoint(d, &tape->states[tape->made], 0, y_, all);
  for (int i = tape->made - 1; i >= 0; i--) step_adjoint(d, &tape->states[i], 1, y_, all);
}
