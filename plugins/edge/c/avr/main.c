/* The self-test on an AVR, whose int has 16 bits; simavr prints what the serial port sends, and
 * ends at a sleep without interrupts. */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>

#include "edge_check.h"
#include "edge_vectors.h"

static edge_t edge;
static edge_count_t counts[EDGE_N_CELLS];
static uint8_t frame[EDGE_FRAME_BYTES];

static void print(const char *text)
{
    while (*text)
        UDR0 = (uint8_t)*text++;
}

int main(void)
{
    UCSR0B = 1u << TXEN0;
    print(edge_check(&edge, counts, frame) ? "wrong frames\n" : "all frames as expected\n");
    cli();
    sleep_mode();
    return 0;
}
