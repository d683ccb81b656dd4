/* The self-test on a Cortex-M4 without an operating system, and the instructions of a frame.
 * QEMU's -icount shift=6 makes an instruction 64 ns of its time, and SysTick counts 40 ns each. */
#include <stddef.h>

#include "edge_check.h"
#include "edge_vectors.h"

#define N_FRAMES 32u
#define NS_INSTRUCTION 64u
#define NS_TICK 40u

typedef void (*handler_t)(void);

extern uint32_t begin_bss[], end_bss[], top_of_stack[];
int main(void);

static volatile uint32_t *const control = (volatile uint32_t *)0xE000E010u;
static volatile uint32_t *const reload = (volatile uint32_t *)0xE000E014u;
static volatile uint32_t *const current = (volatile uint32_t *)0xE000E018u;

static edge_t edge;
static edge_count_t counts[EDGE_N_CELLS];
static uint8_t frame[EDGE_FRAME_BYTES];

/* A request to the debugger (semihosting): 4 writes text, 0x20 ends with an exit code. */
static void ask(uint32_t request, const void *argument)
{
    register uint32_t r0 __asm__("r0") = request;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

static void leave(uint32_t code)
{
    uint32_t block[2];
    block[0] = 0x20026; /* ended by itself */
    block[1] = code;
    ask(0x20, block);
    for (;;) {
    }
}

static void print(const char *text, uint32_t number)
{
    char digits[11];
    unsigned at = 10;

    digits[10] = '\0';
    do {
        digits[--at] = (char)('0' + number % 10);
        number /= 10;
    } while (number);
    ask(4, text);
    ask(4, digits + at);
    ask(4, "\n");
}

void reset(void)
{
    uint32_t *word;
    for (word = begin_bss; word < end_bss; word++)
        *word = 0;
    (void)main();
}

static void fault(void)
{
    print("fault ", 1);
    leave(2);
}

static uint32_t ticks_of(const handler_t work)
{
    uint32_t before;
    *current = 0;
    before = *current;
    work();
    return (before - *current) & 0xffffffu;
}

static void nothing(void)
{
}

static void compress(void)
{
    edge_compress(&edge, counts, frame);
}

int main(void)
{
    const unsigned n_wrong = edge_check(&edge, counts, frame);
    uint64_t sum = 0;
    uint32_t most = 0, empty;
    unsigned k;

    *reload = 0xffffffu;
    *control = 5; /* on, from the processor's clock */
    empty = ticks_of(nothing);
    for (k = 3; k < 3 + N_FRAMES; k++) {
        uint32_t ticks;
        edge_check_counts(k, counts);
        ticks = ticks_of(compress) - empty;
        sum += ticks;
        most = ticks > most ? ticks : most;
    }
    print("test frames ", EDGE_N_VECTORS);
    print("wrong frames ", n_wrong);
    print("instructions mean ", (uint32_t)(sum * NS_TICK / NS_INSTRUCTION / N_FRAMES));
    print("instructions most ", (uint32_t)((uint64_t)most * NS_TICK / NS_INSTRUCTION));
    leave(n_wrong != 0);
    return 0;
}

const handler_t vectors[16] __attribute__((section(".vectors"), used)) = {
    (handler_t)(uintptr_t)top_of_stack, reset, fault, fault, fault, fault, fault,
    NULL, NULL, NULL, NULL, fault, fault, NULL, fault, fault};
