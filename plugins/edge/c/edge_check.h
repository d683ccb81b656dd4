/* The self-test: frames whose bytes are known. */
#ifndef EDGE_CHECK_H
#define EDGE_CHECK_H

#include "edge.h"

/* Fill the counts of test frame k. */
void edge_check_counts(unsigned k, edge_count_t *counts);

/* Compress all test frames; return how many came out with other bytes than expected. */
unsigned edge_check(edge_t *edge, edge_count_t *counts, uint8_t *frame);

#endif
