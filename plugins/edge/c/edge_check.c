#include "edge_check.h"

#include "edge_vectors.h"

/* Frames 0, 1, 2: untouched, at full scale, one taxel of 1 count; then pseudo-random counts
 * (xorshift; Marsaglia, "Xorshift RNGs", J. Stat. Softw. 8(14), 2003), sparse in every other. */
void edge_check_counts(unsigned k, edge_count_t *counts)
{
    uint32_t state = 2463534242u + k;
    unsigned i;

    for (i = 0; i < EDGE_N_CELLS; i++) {
        uint32_t count = 0;
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        if (k == 1)
            count = EDGE_FULL_SCALE;
        else if (k == 2)
            count = i == EDGE_FIRST_CELL;
        else if (k > 2 && ((k & 1u) || (state >> 28) == 0))
            count = (state & 0xffffu) & EDGE_FULL_SCALE;
        counts[i] = (edge_count_t)count;
    }
}

/* FNV-1a, 32 bits (Fowler, Noll, Vo; RFC 9923). */
static uint32_t hash_of(const uint8_t *data, uint32_t n)
{
    uint32_t hash = 0x811c9dc5u, i;

    for (i = 0; i < n; i++)
        hash = (hash ^ data[i]) * 0x01000193u;
    return hash;
}

unsigned edge_check(edge_t *edge, edge_count_t *counts, uint8_t *frame)
{
    unsigned k, n_wrong = 0;

    edge_init(edge);
    for (k = 0; k < EDGE_N_VECTORS; k++) {
        edge_check_counts(k, counts);
        edge_compress(edge, counts, frame);
        n_wrong += hash_of(frame, EDGE_FRAME_BYTES) != edge_vectors[k];
    }
    return n_wrong;
}
