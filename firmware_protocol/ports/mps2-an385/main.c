/* The board's core on a Cortex-M3: UART 0 is the host, UART 1 the log, UART 2 the bench.

   The bench simulates the environment. It sends the configuration whenever the log requests it with C, then commands:
   input levels (I, one byte), link lost (L), reset (R), and faults: the main loop stops (H), the tick is late (T), the
   gate's readback freezes (S). */

#include <string.h>

#include "board.h"
#include "chip.h"

static struct board board;
static uint8_t inputs = INPUT_INTERLOCK | INPUT_KEY;
static bool gate_on, readback_stuck, readback_value, loop_stopped;
static uint32_t entropy_state;

/* --- log: one line of numbers per event, decoded by the bench --- */

static void write_numbers(char kind, const uint64_t *numbers, size_t n) {
    uint8_t line[256], digits[20];
    size_t length = 0;
    line[length++] = (uint8_t)kind;
    for (size_t k = 0; k < n; k++) {
        size_t count = 0;
        uint64_t left = numbers[k];
        do {
            digits[count++] = (uint8_t)('0' + left % 10u);
            left /= 10u;
        } while (left);
        line[length++] = ' ';
        while (count) {
            line[length++] = digits[--count];
        }
    }
    line[length++] = '.'; /* marks a line that no reset has truncated */
    line[length++] = '\n';
    chip_write(UART_WITNESS, line, length);
}

static void on_trace(void *context, const struct board_trace *event) {
    (void)context;
    uint64_t numbers[] = {event->at_us, (uint64_t)event->kind, event->on,    event->is_point, event->state,
                          event->before, event->reason,        event->fault, event->x,        event->y,
                          event->duty,   event->index,         event->on_us, event->off_us};
    write_numbers('T', numbers, sizeof numbers / sizeof numbers[0]);
}

/* --- the HAL --- */

static void on_gate(void *context, bool on, uint16_t duty) {
    (void)context;
    if (on != gate_on) {
        uint64_t numbers[] = {chip_now_us(), on, duty}; /* actual time of the pin's change */
        write_numbers('G', numbers, 3);
    }
    gate_on = on;
}

static bool on_gate_readback(void *context) {
    (void)context;
    return readback_stuck ? readback_value : gate_on;
}

static void on_mirrors(void *context, uint16_t x, uint16_t y) { (void)context, (void)x, (void)y; }

static uint8_t on_inputs(void *context) {
    (void)context;
    return inputs;
}

static void ignore_output(void *context, bool on) { (void)context, (void)on; }

/* The emulated chip has no entropy source; the configuration contains a seed. */
static uint32_t on_entropy(void *context) {
    (void)context;
    entropy_state += 0x9e3779b9u;
    uint32_t mixed = entropy_state;
    mixed = (mixed ^ mixed >> 16) * 0x85ebca6bu;
    mixed = (mixed ^ mixed >> 13) * 0xc2b2ae35u;
    return mixed ^ mixed >> 16;
}

static int16_t on_temperature(void *context) {
    (void)context;
    return 250;
}

static void on_send(void *context, const uint8_t *frame, size_t length) {
    (void)context;
    chip_flush(UART_WITNESS); /* the log precedes the answer, also if a full socket delayed its last byte */
    chip_write(UART_HOST, frame, length);
}

static void on_forget(void *context) { (void)context; /* frames are sent immediately */ }

static void on_feed_watchdog(void *context) {
    (void)context;
    chip_feed_watchdog();
}

static const struct board_hal hal = {
    .set_gate = on_gate,
    .read_gate = on_gate_readback,
    .move_mirrors = on_mirrors,
    .read_inputs = on_inputs,
    .set_indicator = ignore_output,
    .set_relay = ignore_output,
    .read_entropy = on_entropy,
    .read_temperature_dc = on_temperature,
    .send = on_send,
    .discard_output = on_forget,
    .feed_watchdog = on_feed_watchdog,
    .trace = on_trace,
};

/* --- the bench --- */

static struct board_config config;

static void read_exactly(uint8_t *bytes, size_t n) {
    for (size_t have = 0; have < n;) {
        have += chip_read(UART_BENCH, bytes + have, n - have);
        if (have < n) {
            chip_sleep(UINT64_MAX, false);
        }
    }
}

/* The configuration as the bench packs it: u32 seed, u32 firmware, u8[12] uid, u16 cell_codes, u16 queue_points,
   u8 key_edge, u8 inputs, then the limits as in LIMITS. */
#define CONFIG_SIZE (4u + 4u + 12u + 2u + 2u + 1u + 1u + LIMITS_SIZE)

static uint16_t get_u16(const uint8_t *at) { return (uint16_t)(at[0] | at[1] << 8); }
static uint32_t get_u32(const uint8_t *at) { return get_u16(at) | (uint32_t)get_u16(at + 2) << 16; }

static void configure(void) {
    uint8_t bytes[CONFIG_SIZE];
    chip_write(UART_WITNESS, (const uint8_t *)"\n", 1); /* ends a line that a reset truncated */
    write_numbers('C', NULL, 0);
    read_exactly(bytes, sizeof bytes);
    entropy_state = get_u32(bytes);
    config.firmware = get_u32(bytes + 4);
    memcpy(config.uid, bytes + 8, 12);
    config.cell_codes = get_u16(bytes + 20);
    config.queue_points = get_u16(bytes + 22);
    config.key_edge = bytes[24] != 0;
    inputs = bytes[25];
    const uint8_t *at = bytes + 26;
#define DECODE(name, bits, offset, way) \
    config.limits.name = (uint##bits##_t)(bits == 16 ? get_u16(at + (offset)) : get_u32(at + (offset)));
    LIMITS_FIELDS(DECODE)
#undef DECODE
}

static void reset(void) {
    uint64_t now_us = chip_now_us();
    if (gate_on) {
        on_trace(NULL, &(struct board_trace){.at_us = now_us, .kind = TRACE_GATE});
    }
    board_init(&board, &hal, &config, RESET_RESET, now_us);
}

/* Runs a tick at the same time, since the emulator's next one may come later than a millisecond. */
static void set_inputs(uint8_t value, uint64_t now_us) {
    uint64_t numbers[] = {now_us, value};
    write_numbers('I', numbers, 2);
    inputs = value;
    board_tick(&board, now_us);
}

static void miss_ticks(void) {
    uint64_t until_us = chip_now_us() + BOARD_TICK_LATE_US + 2u * BOARD_TICK_US;
    while (chip_now_us() < until_us) {
        chip_sleep(until_us, false);
    }
}

static void run_bench_commands(void) {
    uint8_t command, value;
    while (chip_read(UART_BENCH, &command, 1)) {
        switch (command) {
        case 'I':
            read_exactly(&value, 1);
            set_inputs(value, chip_now_us());
            break;
        case 'L':
            board_on_link_lost(&board, chip_now_us());
            break;
        case 'R':
            reset();
            break;
        case 'H':
            loop_stopped = true;
            break;
        case 'T':
            miss_ticks();
            break;
        case 'S':
            readback_value = gate_on;
            readback_stuck = true;
            break;
        }
    }
}

static void run_loop_once(void) {
    uint8_t bytes[256];
    size_t n = chip_read(UART_HOST, bytes, sizeof bytes);
    uint64_t until_us = board.lease_until_us, now_us = chip_now_us();
    board_receive(&board, bytes, n, now_us);
    if (board.lease_until_us != until_us) {
        uint64_t numbers[] = {now_us, board.lease_until_us};
        write_numbers('P', numbers, 2); /* end of the lease */
    }
}

int main(void) {
    bool watchdog_reset = chip_start();
    configure();
    board_init(&board, &hal, &config, watchdog_reset ? RESET_WATCHDOG : RESET_POWER_UP, chip_now_us());
    for (;;) {
        chip_sleep(board_next_due_us(&board), !loop_stopped);
        board_tick(&board, chip_now_us());
        run_bench_commands();
        if (!loop_stopped) {
            run_loop_once();
        }
    }
}
