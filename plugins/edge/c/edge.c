#include "edge.h"

#include "edge_tables.h"

#define VERSION 1u /* of the frame */
#define TOP ((uint32_t)(1u << (EDGE_BITS - 1)) - 1u) /* largest code */
#define SIGN 0x80000000u
#define HIDDEN 0x00800000u /* the bit of a float32 that is not stored */
#define FRACTION 0x007fffffu

/* Zeros above the highest bit of a number above 0. */
static unsigned leading_zeros(uint32_t value)
{
#if defined(__GNUC__) && !defined(EDGE_NO_BUILTINS)
    return (unsigned)__builtin_clzl((unsigned long)value)
           - 8u * (unsigned)(sizeof(unsigned long) - sizeof(uint32_t));
#else
    unsigned n = 0;
    while (!(value & SIGN)) {
        value <<= 1;
        n++;
    }
    return n;
#endif
}

/* A count above that at rest, at most full scale. */
static int32_t limited(const edge_count_t *counts, const edge_count_t *rest, uint16_t cell)
{
    uint32_t count = counts[cell];

    if (rest)
        count = count > rest[cell] ? count - rest[cell] : 0;
    return (int32_t)(count < EDGE_FULL_SCALE ? count : EDGE_FULL_SCALE);
}

/* Hadamard transform of the counts of some cells, in Sylvester's order of rows. */
static void transform(const edge_count_t *counts, const edge_count_t *rest, const uint16_t *cell,
                      unsigned log2_size, int32_t *v)
{
    const unsigned size = 1u << log2_size;
    unsigned half = 1, i, j;

    if (log2_size & 1u) { /* one stage of pairs, then stages of fours */
        for (i = 0; i < size; i += 2) {
            const int32_t a = limited(counts, rest, cell[i]), b = limited(counts, rest, cell[i + 1]);
            v[i] = a + b;
            v[i + 1] = a - b;
        }
        half = 2;
    } else {
        for (i = 0; i < size; i++)
            v[i] = limited(counts, rest, cell[i]);
    }
    for (; half < size; half *= 4) {
        for (i = 0; i < size; i += 4 * half) {
            int32_t *p = v + i;
            for (j = 0; j < half; j++, p++) {
                const int32_t a = p[0], b = p[half], c = p[2 * half], d = p[3 * half];
                const int32_t ab = a + b, a_b = a - b, cd = c + d, c_d = c - d;
                p[0] = ab + cd;
                p[half] = a_b + c_d;
                p[2 * half] = ab - cd;
                p[3 * half] = a_b - c_d;
            }
        }
    }
}

/* sum * scale * 2^(exponent - 31), rounded to float32 as IEEE 754 does, as its 32 bits. */
static uint32_t scaled(int32_t sum, uint32_t scale, int exponent)
{
    uint32_t sign, size, high, low, bits;
    unsigned zeros;
    uint64_t product;

    if (sum == 0)
        return 0;
    sign = sum < 0 ? SIGN : 0;
    size = sum < 0 ? 0u - (uint32_t)sum : (uint32_t)sum;
    zeros = leading_zeros(size);
    product = (uint64_t)(size << zeros) * scale; /* 2^62 .. 2^64 */
    high = (uint32_t)(product >> 32);
    low = (uint32_t)product;
    if (!(high & SIGN)) {
        high = (high << 1) | (low >> 31);
        low <<= 1;
        zeros++;
    }
    /* 24 bits stay; to the nearest, ties to even. A carry moves into the exponent. */
    bits = ((uint32_t)(127 + 31 + 1 + exponent - (int)zeros) << 23) + ((high >> 8) & FRACTION);
    if ((high & 0x80u) && ((high & 0x17fu) | low) != 0)
        bits++;
    return sign | bits;
}

/* A float32 above 0 divided by TOP, rounded to float32; both as bits. */
static uint32_t divided_by_top(uint32_t bits)
{
    const uint64_t mantissa = (uint64_t)((bits & FRACTION) | HIDDEN) << 32;
    uint64_t quotient = mantissa / TOP, sticky = mantissa % TOP;
    uint32_t exponent = (bits >> 23) - 32u, result;

    while (quotient >> 25) { /* 25 bits: the last one decides the rounding */
        sticky |= quotient & 1u;
        quotient >>= 1;
        exponent++;
    }
    exponent++;
    result = (exponent << 23) + ((uint32_t)(quotient >> 1) & FRACTION);
    if ((quotient & 1u) && (sticky || (quotient & 2u)))
        result++;
    return result;
}

/* CRC-16 of polynomial 0x1021, start 0xffff, not reflected (CRC-16/IBM-3740), a byte at a time:
 * x^16 = x^12 + x^5 + 1, and the 4 highest bits of a byte return once more. */
static uint16_t crc16(const uint8_t *data, uint32_t n)
{
    uint32_t crc = 0xffff, i;

    for (i = 0; i < n; i++) {
        uint32_t byte = ((crc >> 8) & 0xffu) ^ data[i];
        byte ^= byte >> 4;
        crc = (crc << 8) ^ (byte << 12) ^ (byte << 5) ^ byte;
    }
    return (uint16_t)(crc & 0xffffu);
}

static uint8_t *put(uint8_t *out, uint32_t value, unsigned n_bytes)
{
    while (n_bytes--) {
        *out++ = (uint8_t)(value & 0xffu);
        value >>= 8;
    }
    return out;
}

/* Measure the rows of this subset; return the bits of the largest |y|. */
static uint32_t measure(edge_t *edge, const edge_count_t *counts)
{
    int32_t v[EDGE_BLOCK < 4 ? 4 : EDGE_BLOCK]; /* at least 4: compilers then see that all fit */
    const uint16_t *cell = edge_cells;
    const uint32_t *rows = edge_rows[edge->subset];
    uint32_t *y = edge->y, largest = 0, row = 0;
    unsigned group, block, i;

    for (group = 0; group < EDGE_N_GROUPS; group++) {
        const edge_group_t *g = &edge_groups[group];
        const unsigned size = 1u << g->log2_size, step = size < 32 ? size : 32;
        const uint32_t all = step < 32 ? ((uint32_t)1 << step) - 1u : 0xffffffffu;
        for (block = 0; block < g->n_blocks; block++) {
            transform(counts, edge->rest, cell, g->log2_size, v);
            cell += size;
            for (i = 0; i < size; i += step, row += step) {
                uint32_t kept = (rows[row >> 5] >> (row & 31u)) & all;
                while (kept) {
                    const uint32_t lowest = kept & (0u - kept);
                    const uint32_t bits =
                        scaled(v[i + 31u - leading_zeros(lowest)], g->scale, g->exponent);
                    if ((bits & ~SIGN) > largest)
                        largest = bits & ~SIGN;
                    *y++ = bits;
                    kept ^= lowest;
                }
            }
        }
    }
    return largest;
}

/* Write each measurement / step, rounded to a whole number, ties to even: EDGE_BITS bits of
 * (code + TOP), the highest first. Exact: the quotient is estimated by a reciprocal of the step,
 * at most 1 too small, and corrected by its remainder. */
static uint8_t *write_codes(const edge_t *edge, uint32_t step, uint8_t *out)
{
    const uint32_t divisor = (step & FRACTION) | HIDDEN;
    const int exponent = (int)(step >> 23);
    const uint32_t reciprocal = (uint32_t)(((uint64_t)1 << 47) / divisor);
    uint32_t held = 0, i;
    unsigned n_held = 0;

    for (i = 0; i < EDGE_M; i++) {
        const uint32_t bits = edge->y[i];
        const uint32_t mantissa = (bits & FRACTION) | HIDDEN;
        const int shift = (int)((bits & ~SIGN) >> 23) - exponent;
        uint32_t code = 0;
        if (shift >= 0) {
            const uint64_t product = (uint64_t)mantissa * reciprocal;
            uint32_t rest;
            code = (uint32_t)(product >> (47 - shift));
            rest = (mantissa << shift) - code * divisor; /* modulo 2^32; it is below 2^25 */
            if (rest >= divisor) {
                rest -= divisor;
                code++;
            }
            if (2 * rest > divisor || (2 * rest == divisor && (code & 1u)))
                code++;
        } else if (shift == -1) {
            code = mantissa > divisor; /* a quotient of 1/4 .. 1 */
        }
        held = (held << EDGE_BITS) | ((bits & SIGN) ? TOP - code : TOP + code);
        for (n_held += EDGE_BITS; n_held >= 8; n_held -= 8)
            *out++ = (uint8_t)((held >> (n_held - 8)) & 0xffu);
    }
    if (n_held)
        *out++ = (uint8_t)((held << (8 - n_held)) & 0xffu);
    return out;
}

void edge_init(edge_t *edge)
{
    edge->rest = 0;
    edge->seq = 0;
    edge->subset = 0;
}

void edge_compress(edge_t *edge, const edge_count_t *counts, uint8_t *frame)
{
    const uint32_t largest = measure(edge, counts);
    const uint32_t step = largest ? divided_by_top(largest) : EDGE_STEP_OF_ZEROS;
    uint8_t *out = put(frame, 0x55aa, 2);

    out = put(out, edge->seq, 2);
    out = put(out, VERSION, 1);
    out = put(out, edge_phi[edge->subset], 4);
    out = put(out, step, 4);
    out = write_codes(edge, step, out);
    put(out, crc16(frame + 2, (uint32_t)(out - frame) - 2), 2);
    edge->seq = (uint16_t)(edge->seq + 1u);
    edge->subset = (uint8_t)((edge->subset + 1u) % EDGE_N_SUBSETS);
}
