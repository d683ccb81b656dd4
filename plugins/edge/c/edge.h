/* Compression of one frame of a tactile skin: integer arithmetic, no heap, no library. */
#ifndef EDGE_H
#define EDGE_H

#include <stdint.h>

#include "edge_config.h"

/* Memory of one edge, about 4 bytes a measurement. Make it static: it may not fit a stack. */
typedef struct {
    uint32_t y[EDGE_M];  /* measurements of this frame: sign and float32 */
    uint16_t seq;        /* number of the next frame, modulo 65536 */
    uint8_t subset;      /* row subset of the next frame */
} edge_t;

/* Begin with frame 0 and the first row subset. */
void edge_init(edge_t *edge);

/* Compress one frame.
 * counts: EDGE_N_ROWS x EDGE_N_COLS readings, row by row, each 0 .. EDGE_FULL_SCALE (a larger one
 *         is read as EDGE_FULL_SCALE); those of cells without a taxel are not read.
 * frame:  EDGE_FRAME_BYTES bytes to send. */
void edge_compress(edge_t *edge, const edge_count_t *counts, uint8_t *frame);

#endif
