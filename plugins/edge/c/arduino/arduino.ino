/* The edge as an Arduino sketch: a multiplexer selects a cell of the skin, an analog pin reads it.
 * The skin is to be untouched while the board starts: what it reads then is subtracted. */
#include "edge.h"

static const uint8_t ROW_PINS[] = {22, 23, 24, 25, 26, 27}; /* number of the row, lowest bit first */
static const uint8_t COL_PINS[] = {30, 31, 32, 33, 34, 35};
static const unsigned long BAUD = 1000000;

static edge_t edge;
static edge_count_t rest[EDGE_N_CELLS], counts[EDGE_N_CELLS];
static uint8_t frame[EDGE_FRAME_BYTES];

static void select(const uint8_t *pins, uint8_t n_pins, unsigned number)
{
    for (uint8_t k = 0; k < n_pins; k++)
        digitalWrite(pins[k], (number >> k) & 1u ? HIGH : LOW);
}

static void read_cells(edge_count_t *cell)
{
    for (unsigned row = 0; row < EDGE_N_ROWS; row++) {
        select(ROW_PINS, sizeof ROW_PINS, row);
        for (unsigned col = 0; col < EDGE_N_COLS; col++) {
            select(COL_PINS, sizeof COL_PINS, col);
            *cell++ = (edge_count_t)analogRead(A0);
        }
    }
}

void setup()
{
    for (uint8_t pin : ROW_PINS)
        pinMode(pin, OUTPUT);
    for (uint8_t pin : COL_PINS)
        pinMode(pin, OUTPUT);
    Serial.begin(BAUD);
    edge_init(&edge);
    read_cells(rest);
    edge.rest = rest;
}

void loop()
{
    read_cells(counts);
    edge_compress(&edge, counts, frame);
    Serial.write(frame, EDGE_FRAME_BYTES);
}
