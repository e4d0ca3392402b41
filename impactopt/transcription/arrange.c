/* Sorts the operations of a function into runs of one kind, for the instruction tables of simd.py.

   Values have numbers: first those at fixed places (inputs, constants, outputs), then one for each
   operation. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

enum { COPY, KINDS = 256, LONGEST = 65535 }; /* LONGEST run: its length fits into 16 bits */
enum { LOAD = 250, STORE, SUM_OF_PRODUCT, PRODUCT_LESS, LESS_PRODUCT };

typedef struct {
    int32_t kind, reads, read[3];
} operation;

typedef struct {
    operation *all;
    int32_t count, fixed, *uses, *order, *place;
    uint8_t *merged; /* flags of operations that became part of another one */
} graph;

/* Number of an operation, which is added to the graph unless an equal one is there (value numbering).
   table (mask + 1) : hash table with open addressing, of numbers + 1; 0: free. */
static int32_t value_number(graph *g, operation o, int32_t *table, uint64_t mask) {
    uint64_t at = o.kind;
    for (int i = 0; i < o.reads; ++i) at = (at ^ (uint32_t)o.read[i]) * 0x9E3779B97F4A7C15u, at ^= at >> 29;
    for (at &= mask; table[at]; at = (at + 1) & mask)
        if (!memcmp(g->all + table[at] - 1, &o, sizeof o)) return table[at] - 1;
    g->all[g->count] = o;
    table[at] = ++g->count;
    return g->count - 1;
}

/* Merges each product that has only one use, in a sum or difference, with that operation. */
static void join_products(graph *g, int32_t add, int32_t subtract, int32_t multiply) {
    for (int32_t k = 0; k < g->count; ++k) {
        operation *o = g->all + k;
        if (o->kind != add && o->kind != subtract) continue;
        for (int side = 1; side >= 0; --side) {
            const int32_t p = o->read[side] - g->fixed, other = o->read[1 - side];
            if (p < 0 || g->all[p].kind != multiply || g->uses[p] != 1) continue;
            o->kind = o->kind == add ? SUM_OF_PRODUCT : side ? LESS_PRODUCT : PRODUCT_LESS;
            memcpy(o->read, g->all[p].read, 2 * sizeof *o->read);
            o->read[2] = other, o->reads = 3, g->merged[p] = 1;
            break;
        }
    }
}

typedef struct {
    int32_t first[KINDS], last[KINDS], size[KINDS], *next;
    int32_t *missing;   /* of each operation: number of operands not yet computed; -1: it is done */
    int32_t base, end;  /* the first operation that is not done, and the window's end */
} schedule;             /* first, last, size, next: a queue of operations for each kind, as linked lists */

static void append(schedule *s, const graph *g, int32_t k) {
    const int32_t kind = g->all[k].kind;
    if (s->size[kind]++) s->next[s->last[kind]] = k;
    else s->first[kind] = k;
    s->last[kind] = k;
}

static void move_window(schedule *s, const graph *g, int32_t window) {
    while (s->base < g->count && (g->merged[s->base] || s->missing[s->base] < 0)) ++s->base;
    for (; s->end < g->count && s->end - s->base < window; ++s->end)
        if (!s->missing[s->end] && !g->merged[s->end]) append(s, g, s->end);
}

/* Topological order in long runs of one kind, greedily: all available operations of the kind that has most,
   then those of the next such kind. None is more than `window` ahead of the first that is not done. Returns
   the number of operations, without merged ones.
   start (count + 1), users (3 count), next, missing (count) : zeroed work space. */
static int32_t order_operations(graph *g, int32_t window, int32_t *start, int32_t *users, int32_t *next,
                        int32_t *missing) {
    schedule s = {.next = next, .missing = missing};
    int32_t done = 0;
    for (int32_t k = 0; k < g->count; ++k)
        for (int i = 0; i < g->all[k].reads && !g->merged[k]; ++i)
            if (g->all[k].read[i] >= g->fixed) ++missing[k], ++start[g->all[k].read[i] - g->fixed + 1];
    /* users[start[k] ... start[k + 1] - 1] are the operations that read k */
    for (int32_t k = 0; k < g->count; ++k) start[k + 1] += start[k];
    for (int32_t k = 0; k < g->count; ++k)
        for (int i = 0; i < g->all[k].reads && !g->merged[k]; ++i)
            if (g->all[k].read[i] >= g->fixed) users[start[g->all[k].read[i] - g->fixed]++] = k;
    for (int32_t k = g->count; k > 0; --k) start[k] = start[k - 1];
    start[0] = 0;
    for (;;) {
        int32_t kind = 0;
        move_window(&s, g, window);
        for (int32_t other = 1; other < KINDS; ++other)
            if (s.size[other] > s.size[kind]) kind = other;
        if (!s.size[kind]) return done;
        while (s.size[kind]) {
            const int32_t k = s.first[kind];
            s.first[kind] = next[k], --s.size[kind];
            missing[k] = -1, g->order[done++] = k;
            for (int32_t u = start[k]; u < start[k + 1]; ++u)
                if (!--missing[users[u]] && users[u] < s.end) append(&s, g, users[u]);
            move_window(&s, g, window);
        }
    }
}

static int32_t place_of(const graph *g, int32_t value) {
    return value < g->fixed ? value : g->place[value - g->fixed];
}

typedef struct {
    uint32_t *end, *run;
} program;

/* Appends an operation to the last run, or to a new one if that has another kind or is full. */
static void emit(program *p, int32_t kind, int32_t reads, const int32_t *places, int32_t to) {
    if (!p->run || (int32_t)p->run[0] != kind || p->run[1] == LONGEST) {
        p->run = p->end, p->end += 2;
        p->run[0] = kind, p->run[1] = 0;
    }
    ++p->run[1];
    for (int i = 0; i < reads; ++i) *p->end++ = places[i];
    *p->end++ = to;
}

/* Assigns a place to each value, reusing places of values that no later operation reads, and emits all
   operations. Returns the number of places.
   stored (outputs) : the value of each output.  spare (count) : work space, a stack of free places. */
static int32_t assign_places(graph *g, int32_t done, int32_t outputs, const int32_t *stored, int32_t *spare,
                       program *p) {
    int32_t top = g->fixed, spares = 0, first = g->fixed - outputs, *last = g->uses;
    for (int32_t k = 0; k < g->count; ++k) last[k] = g->place[k] = -1;
    for (int32_t k = 0; k < done; ++k) {
        const operation *o = g->all + g->order[k];
        for (int i = 0; i < o->reads; ++i)
            if (o->read[i] >= g->fixed) last[o->read[i] - g->fixed] = k;
    }
    /* a value that is an output is computed in place */
    for (int32_t k = 0; k < outputs; ++k) {
        const int32_t v = stored[k] - g->fixed;
        if (v >= 0 && g->place[v] < 0) g->place[v] = first + k, last[v] = -1;
    }
    for (int32_t k = 0; k < done; ++k) {
        const int32_t own = g->order[k];
        const operation *o = g->all + own;
        int32_t places[3] = {0};
        for (int i = 0; i < o->reads; ++i) places[i] = place_of(g, o->read[i]);
        for (int i = 0; i < o->reads; ++i) {
            const int32_t v = o->read[i] - g->fixed;
            if (v >= 0 && last[v] == k) last[v] = -1, spare[spares++] = g->place[v];
        }
        if (g->place[own] < 0) g->place[own] = spares ? spare[--spares] : top++;
        emit(p, o->kind, o->reads, places, g->place[own]);
    }
    /* outputs that are inputs, constants or other outputs are copied */
    for (int32_t k = 0; k < outputs; ++k) {
        const int32_t from = place_of(g, stored[k]);
        if (from != first + k) emit(p, COPY, 1, &from, first + k);
    }
    return top;
}

/* Writes the instruction table: runs of a kind, a number of operations, and for each of them the places that
   it reads and the one that it writes. Returns the number of words, or -1 without memory.

   kinds, first, second, result (n) : instructions on registers. LOAD reads the place `first`, STORE writes
       the register `first` to the place `result`; COPY.  second : -1 if there is none.
   add, subtract, multiply : their kinds.  fixed : number of places of inputs, constants, and outputs, which
       come last.  words (6 n), places (1) : results; `places` is their number. */
EXPORT int64_t arrange(int32_t n, const int32_t *kinds, const int32_t *first, const int32_t *second,
                       const int32_t *result, int32_t registers, int32_t add, int32_t subtract,
                       int32_t multiply, int32_t fixed, int32_t outputs, int32_t window, uint32_t *words,
                       int32_t *places) {
    uint64_t mask = 1;
    while (mask < 2 * (uint64_t)n + 2) mask *= 2;
    const int64_t size = (int64_t)n + 1;
    int32_t *work = calloc(10 * size + registers + outputs + mask, sizeof *work), *stored = work + 10 * size,
            *holds = stored + outputs, *table = holds + registers;
    graph g = {.all = calloc(size, sizeof *g.all), .fixed = fixed, .merged = calloc(size, 1)};
    program p = {words, NULL};
    int64_t length = -1;
    if (work && g.all && g.merged) {
        g.uses = work, g.order = work + size, g.place = work + 2 * size;
        for (int32_t k = 0; k < n; ++k) {
            if (kinds[k] == LOAD) holds[result[k]] = first[k];
            else if (kinds[k] == STORE) stored[result[k] - (fixed - outputs)] = holds[first[k]];
            else if (kinds[k] == COPY) holds[result[k]] = holds[first[k]];
            else {
                operation o = {kinds[k], 1, {holds[first[k]], 0, 0}};
                if (second[k] >= 0) o.read[1] = holds[second[k]], o.reads = 2;
                /* operands of commutative operations in one order, so that equal operations are found */
                if ((o.kind == add || o.kind == multiply) && o.read[0] > o.read[1])
                    o.read[0] = o.read[1], o.read[1] = holds[first[k]];
                holds[result[k]] = fixed + value_number(&g, o, table, mask - 1);
            }
        }
        for (int32_t k = 0; k < g.count; ++k)
            for (int i = 0; i < g.all[k].reads; ++i)
                if (g.all[k].read[i] >= fixed) ++g.uses[g.all[k].read[i] - fixed];
        for (int32_t k = 0; k < outputs; ++k)
            if (stored[k] >= fixed) g.uses[stored[k] - fixed] += 2; /* so that outputs are never merged */
        join_products(&g, add, subtract, multiply);
        const int32_t done =
            order_operations(&g, window, work + 3 * size, work + 4 * size, work + 7 * size, work + 8 * size);
        *places = assign_places(&g, done, outputs, stored, work + 9 * size, &p);
        length = p.end - words;
    }
    free(work), free(g.all), free(g.merged);
    return length;
}
