#include "xy2_100.h"

#include "chip.h"
#include "pins.h"
#include "registers.h"

/* A bit lasts eight cycles of the PIO: the clock is high for four, data and SYNC change as it rises, and the head takes them
   as it falls. The status is read at the end of the bit, when the way to the head and back has passed. */
#define PIO_HZ 16000000u
_Static_assert((uint64_t)CLOCK_HZ * 256u % PIO_HZ == 0, "2 MHz exactly");
#define PIO_DIVIDER ((uint32_t)((uint64_t)CLOCK_HZ * 256u / PIO_HZ) << 8)

#define STATUS_FRAMES 2u

/* make MUTANT=n, which the tests must detect: 111 inverts the parity bit, 112 sends other control bits, 113 repeats no frame,
   114 lacks a bit of each. */
#ifndef MUTANT
#define MUTANT 0
#endif
#define CONTROL_BITS (MUTANT == 112 ? 2u : 1u) /* 001: a position of 16 bits */
#define PARITY (MUTANT == 111 ? 0u : 1u)       /* of the control bits */

/* --- the program: both state machines run it in step, one per axis, and both drive clock and SYNC --- */

/* clock and SYNC during an instruction, and the cycles that it lasts */
#define AT(clock, sync, cycles) (((sync) << 4 | (clock) << 3 | ((cycles) - 1u)) << 8)
#define HIGH(cycles) AT(1u, 1u, cycles)
#define LOW(cycles) AT(0u, 1u, cycles)
#define JMP_Y_DECREMENT(to) (0x0080u | (to))
#define IN_STATUS 0x4001u
#define OUT_BIT 0x6001u
#define PUSH_NO_WAIT 0x8000u
#define PULL_NO_WAIT (MUTANT == 113 ? 0x80a0u : 0x8080u) /* takes X if there is nothing */
#define MOV_X_OSR 0xa027u
#define NOP 0xa042u
#define SET_BIT(value) (0xe000u | (value))
#define SET_Y(value) (0xe040u | (value))
#define SET_PIN_DIRECTIONS(bits) (0xe080u | (bits))

#define LOOP 10u
static const uint16_t PROGRAM[] = {
    SET_BIT(CONTROL_BITS >> 2 & 1u) | HIGH(4u),
    PUSH_NO_WAIT | LOW(3u), /* the status of the frame before; the DMA answers it with the next positions */
    IN_STATUS | LOW(1u),
    SET_BIT(CONTROL_BITS >> 1 & 1u) | HIGH(4u),
    NOP | LOW(3u),
    IN_STATUS | LOW(1u),
    SET_BIT(CONTROL_BITS & 1u) | HIGH(4u),
    PULL_NO_WAIT | LOW(1u), /* what the DMA answered, a µs ago */
    MOV_X_OSR | LOW(1u),
    SET_Y(MUTANT == 114 ? 14u : 15u) | LOW(1u),
    [LOOP] = IN_STATUS | LOW(1u), /* of the bit before */
    OUT_BIT | HIGH(4u),
    JMP_Y_DECREMENT(LOOP) | LOW(3u),
    IN_STATUS | LOW(1u),
    OUT_BIT | AT(1u, 0u, 4u), /* parity */
    NOP | AT(0u, 0u, 3u),
    IN_STATUS | AT(0u, 0u, 1u),
};
#define PROGRAM_SIZE (sizeof PROGRAM / sizeof PROGRAM[0])

/* --- positions and status in memory --- */

static uint32_t find_parity(uint32_t bits) {
    bits ^= bits >> 16;
    bits ^= bits >> 8;
    bits ^= bits >> 4;
    return 0x6996u >> (bits & 15u) & 1u;
}

/* Position and parity bit, first bit leftmost; the program has the control bits. */
static uint32_t build_word(uint16_t position) {
    return ((uint32_t)position << 1 | (PARITY ^ find_parity(position))) << 15;
}

/* The DMA reads the pair to which `pair` points, while xy2_100_move prepares the other one. */
static uint32_t pairs[2][2];
static const uint32_t *volatile pair = pairs[0];
static volatile uint32_t statuses[STATUS_FRAMES] __attribute__((aligned(4 * STATUS_FRAMES)));

void xy2_100_move(uint16_t x, uint16_t y) {
    uint32_t *next = pairs[pair == pairs[0]];
    next[0] = build_word(x);
    next[1] = build_word(y);
    __asm volatile("" ::: "memory"); /* the DMA may read it from the next instruction on */
    pair = next;
}

static bool is_valid(uint32_t frame) { return frame >> 17 == 1u && !find_parity(frame); }

bool xy2_100_read_status(uint16_t *word) {
    uint16_t common = UINT16_MAX;
    bool came = false;
    for (uint32_t k = 0; k < STATUS_FRAMES; k++) {
        uint32_t frame = statuses[k];
        statuses[k] = 0; /* no valid one: of a head that answers, the next frame replaces it */
        if (is_valid(frame)) {
            common &= (uint16_t)(frame >> 1);
            came = true;
        }
    }
    if (came) {
        *word = common;
    }
    return came;
}

/* --- DMA: a status that the PIO pushed is stored, then the pair's address is read, then the pair is sent; without end --- */

enum { STORE, CHOOSE, SEND };

static void start_dma(void) {
    REGISTER(DMA_READ(STORE)) = PIO_RX(0);
    REGISTER(DMA_WRITE(STORE)) = (uint32_t)statuses;
    REGISTER(DMA_COUNT(STORE)) = 1;
    REGISTER(DMA_READ(CHOOSE)) = (uint32_t)&pair;
    REGISTER(DMA_WRITE(CHOOSE)) = DMA_READ_AND_TRIGGER(SEND);
    REGISTER(DMA_COUNT(CHOOSE)) = 1;
    REGISTER(DMA_CTRL(CHOOSE)) = DMA_ON | DMA_CHAIN(CHOOSE) | DMA_REQUEST(DMA_ALWAYS);
    REGISTER(DMA_WRITE(SEND)) = PIO_TX(0);
    REGISTER(DMA_COUNT(SEND)) = 2;
    REGISTER(DMA_CTRL(SEND)) = DMA_ON | DMA_NEXT_READ | DMA_NEXT_WRITE | DMA_WRITE_RING(3) |
                               DMA_CHAIN(MUTANT == 113 ? SEND : STORE) | DMA_REQUEST(DMA_ALWAYS);
    REGISTER(DMA_CTRL_AND_TRIGGER(STORE)) =
        DMA_ON | DMA_NEXT_WRITE | DMA_WRITE_RING(3) | DMA_CHAIN(CHOOSE) | DMA_REQUEST(DMA_PIO_RX0);
}

static void start_machine(uint32_t machine, uint32_t data_pin) {
    REGISTER(PIO_SHIFT(machine)) = 0; /* leftwards */
    REGISTER(PIO_WRAP(machine)) = (PROGRAM_SIZE - 1u) << 12;
    REGISTER(PIO_CLOCK(machine)) = PIO_DIVIDER;
    REGISTER(PIO_PINS(machine)) = 2u << 29 | 1u << 26 | 1u << 20 | PIN_XY2_STATUS << 15 | PIN_XY2_CLOCK << 10 | data_pin << 5 |
                                  data_pin;
}

void xy2_100_start(void) {
    xy2_100_move(32768u, 32768u);
    for (uint32_t k = 0; k < PROGRAM_SIZE; k++) {
        REGISTER(PIO_PROGRAM(k)) = PROGRAM[k];
    }
    REGISTER(PIO_PINS(0)) = 4u << 26 | PIN_XY2_CLOCK << 5; /* clock, SYNC, X and Y follow each other */
    REGISTER(PIO_EXECUTE(0)) = SET_PIN_DIRECTIONS(15u);
    start_machine(0, PIN_XY2_X);
    start_machine(1, PIN_XY2_Y);
    start_dma();
    REGISTER(PIO_CTRL) = 3u << 8 | 3u << 4 | 3u; /* both in the same cycle */
}
