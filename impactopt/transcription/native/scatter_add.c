/* Sums in runs of neighbours; runs.py says what they are for. */
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))

EXPORT void runs_add(int64_t count, const int32_t *entry, const int32_t *place, const int32_t *length,
                     const double *factor, const double *restrict entries, double *restrict out) {
    for (int64_t k = 0; k < count; ++k) {
        const double *from = entries + entry[k];
        double *to = out + place[k], by = factor[k];
        for (int32_t i = 0; i < length[k]; ++i) to[i] += by * from[i];
    }
}

/* out = values + values of the places across the diagonal */
EXPORT void runs_add_transposed(int64_t count, const int32_t *across, const double *restrict values,
                                double *restrict out) {
    for (int64_t k = 0; k < count; ++k) out[k] = values[k] + values[across[k]];
}
