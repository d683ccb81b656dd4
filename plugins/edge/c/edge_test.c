/* The self-test as a program: exit code 0 if every test frame has the expected bytes. */
#include <stdio.h>

#include "edge_check.h"
#include "edge_vectors.h"

static edge_t edge;
static edge_count_t counts[EDGE_N_CELLS];
static uint8_t frame[EDGE_FRAME_BYTES];

int main(void)
{
    const unsigned n_wrong = edge_check(&edge, counts, frame);

    printf("%u of %u test frames are as expected\n", EDGE_N_VECTORS - n_wrong, EDGE_N_VECTORS);
    return n_wrong != 0;
}
