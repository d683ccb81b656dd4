/* Tables of the measurement matrix, in read-only memory (edge_tables.c). */
#ifndef EDGE_TABLES_H
#define EDGE_TABLES_H

#include <stdint.h>

#include "edge_config.h"

/* A run of Hadamard blocks of one size, 2^log2_size. The rows of such a block are scaled by
 * scale * 2^(exponent - 31), which is 1 / sqrt(size) in float32. */
typedef struct {
    uint16_t n_blocks;
    uint8_t log2_size;
    int8_t exponent;
    uint32_t scale;
} edge_group_t;

extern const edge_group_t edge_groups[EDGE_N_GROUPS];
/* Cell of the frame that each column of the block transform reads. */
extern const uint16_t edge_cells[EDGE_N_TAXELS];
/* A bit for each row of the block transform, the lowest first: 1 if this row subset has it. */
extern const uint32_t edge_rows[EDGE_N_SUBSETS][(EDGE_N_TAXELS + 31) / 32];
/* First 8 hexadecimal digits of the fingerprint of each row subset's matrix. */
extern const uint32_t edge_phi[EDGE_N_SUBSETS];

#endif
