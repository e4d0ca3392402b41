/* Scatter-add in runs of neighbours: the class Runs of structured.py. */
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))

/* out[destination[k] + i] += factor[k] * entries[source[k] + i] for i < length[k] */
EXPORT void runs_add(int64_t count, const int32_t *source, const int32_t *destination, const int32_t *length,
                     const double *factor, const double *restrict entries, double *restrict out) {
    for (int64_t k = 0; k < count; ++k) {
        const double *from = entries + source[k];
        double *to = out + destination[k], by = factor[k];
        for (int32_t i = 0; i < length[k]; ++i) to[i] += by * from[i];
    }
}

/* out[k] = values[k] + values[across[k]], where across[k] is the nonzero mirrored at the diagonal */
EXPORT void runs_add_transposed(int64_t count, const int32_t *across, const double *restrict values,
                                double *restrict out) {
    for (int64_t k = 0; k < count; ++k) out[k] = values[k] + values[across[k]];
}
