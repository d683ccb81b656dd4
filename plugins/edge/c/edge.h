/* Compression of one frame of a tactile skin: integer arithmetic, no heap, no library. */
#ifndef EDGE_H
#define EDGE_H

#include <stdint.h>

#include "edge_config.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Memory of one edge, about 4 bytes per measurement. Make it static: it may not fit a stack. The
 * smallest chip of 16 x 32 taxels at N/3 has 4 kB of RAM where constants stay in flash (1.9 kB are
 * used, and 1.2 kB of stack), and 8 kB where they do not (AVR, 1.2 kB more): no ATmega328. */
typedef struct {
    const edge_count_t *rest; /* counts of the untouched cells, subtracted (down to 0), or 0 */
    uint32_t y[EDGE_M];  /* measurements of this frame: sign and float32 */
    uint16_t seq;        /* number of the next frame, modulo 65536 */
    uint8_t subset;      /* row subset of the next frame */
} edge_t;

/* Begin with frame 0, the first row subset, and counts that are 0 at rest. */
void edge_init(edge_t *edge);

/* Compress one frame.
 * counts: EDGE_N_ROWS x EDGE_N_COLS readings, row by row, each 0 .. EDGE_FULL_SCALE (a larger one
 *         is read as EDGE_FULL_SCALE); those of cells without a taxel are not read.
 * frame:  EDGE_FRAME_BYTES bytes to send. */
void edge_compress(edge_t *edge, const edge_count_t *counts, uint8_t *frame);

#ifdef __cplusplus
}
#endif

#endif
