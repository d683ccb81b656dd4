/* The edge as a program: frames of counts from standard input (EDGE_N_ROWS x EDGE_N_COLS unsigned
 * numbers, row by row, the low byte first, EDGE_COUNT_BYTES each), what the board would send to
 * standard output, or to the file or terminal that the first argument names. */
#include <stdio.h>

#include "edge.h"

static edge_t edge;
static edge_count_t counts[EDGE_N_CELLS];
static uint8_t raw[EDGE_N_CELLS * EDGE_COUNT_BYTES];
static uint8_t frame[EDGE_FRAME_BYTES];

int main(int argc, char **argv)
{
    FILE *out = argc > 1 ? fopen(argv[1], "wb") : stdout;
    size_t i;

    if (out == NULL) {
        perror(argv[1]);
        return 1;
    }
    edge_init(&edge);
    while (fread(raw, sizeof raw, 1, stdin) == 1) {
        for (i = 0; i < EDGE_N_CELLS; i++) {
            unsigned count = raw[EDGE_COUNT_BYTES * i];
#if EDGE_COUNT_BYTES == 2
            count |= (unsigned)raw[2 * i + 1] << 8;
#endif
            counts[i] = (edge_count_t)count;
        }
        edge_compress(&edge, counts, frame);
        if (fwrite(frame, sizeof frame, 1, out) != 1 || fflush(out) != 0) {
            perror(argc > 1 ? argv[1] : "standard output");
            return 1;
        }
    }
    return ferror(stdin) != 0 || fclose(out) != 0;
}
