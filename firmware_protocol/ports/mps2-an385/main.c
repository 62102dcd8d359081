/* The board's core on a Cortex-M3 whose time is the emulator's.

   The bench simulates the environment. It sends the configuration when the chip requests it with the record C, then
   commands: run until a time (U), bytes from the host (B), input levels (I), an edge at the trigger input (E), link
   lost (L), reset (R), and faults: the main loop stops (H), the tick stops (K) or is late (T), the gate's readback freezes (S). Each ends with the record D: the
   chip's time and that of its next due event. */

#include <string.h>

#include "bench.h"
#include "board.h"
#include "chip.h"

#define LOOP_BYTES_MAX 64u

static struct board board;
static uint8_t inputs = INPUT_INTERLOCK | INPUT_KEY;
static bool gate_on, readback_stuck, readback_value, loop_stopped, tick_stopped;
static uint32_t entropy_state, triggers;
static uint64_t trigger_us;

/* --- log --- */

static void on_trace(void *context, const struct board_trace *event) {
    (void)context;
    const struct __attribute__((packed)) {
        uint64_t at_us, on_us, off_us;
        uint32_t index;
        uint16_t x, y, duty;
        uint8_t kind, on, is_point, state, before, reason, fault;
    } record = {event->at_us,          event->on_us, event->off_us,   event->index, event->x,      event->y,      event->duty,
                (uint8_t)event->kind, event->on,    event->is_point, event->state, event->before, event->reason, event->fault};
    bench_write('T', &record, sizeof record);
}

static void write_times(char kind, uint64_t first, uint64_t second) {
    uint64_t times[] = {first, second};
    bench_write(kind, times, sizeof times);
}

/* --- the HAL --- */

static void on_gate(void *context, bool on, uint16_t duty) {
    (void)context, (void)duty;
    if (on != gate_on) {
        write_times('G', chip_now_us(), on); /* actual time of the pin's change */
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

static uint32_t on_triggers(void *context, uint64_t *last_us) {
    (void)context;
    *last_us = trigger_us;
    return triggers;
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
    write_times('A', chip_now_us(), 0); /* time of the frames that follow */
    bench_write('O', frame, length);
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
    .read_triggers = on_triggers,
    .set_indicator = ignore_output,
    .set_relay = ignore_output,
    .read_entropy = on_entropy,
    .read_temperature_dc = on_temperature,
    .send = on_send,
    .discard_output = on_forget,
    .feed_watchdog = on_feed_watchdog,
    .trace = on_trace,
};

/* --- the loop --- */

static void run_loop_once(const uint8_t *bytes, size_t n) {
    if (!tick_stopped) {
        board_tick(&board, chip_now_us());
    }
    if (loop_stopped) {
        return;
    }
    uint64_t until_us = board.lease_until_us, now_us = chip_now_us();
    board_receive(&board, bytes, n, now_us);
    if (board.lease_until_us > until_us) {
        write_times('P', now_us, board.lease_until_us); /* end of the lease */
    }
}

static void run_until(uint64_t end_us) {
    for (uint64_t now_us; (now_us = chip_now_us()) < end_us;) {
        uint64_t tick_us = now_us + BOARD_TICK_US, due_us = board_next_due_us(&board);
        uint64_t at_us = due_us < tick_us ? due_us : tick_us;
        chip_wait_until(at_us < end_us ? at_us : end_us);
        run_loop_once(NULL, 0);
    }
}

/* Returns the number of bytes up to the end of a frame, so that the ticks between two answers are not late. */
static size_t count_to_delimiter(const uint8_t *bytes, size_t n) {
    size_t max = n < LOOP_BYTES_MAX ? n : LOOP_BYTES_MAX;
    for (size_t k = 0; k < max; k++) {
        if (bytes[k] == 0) {
            return k + 1;
        }
    }
    return max;
}

static void receive(const uint8_t *bytes, size_t n) {
    for (size_t at = 0, count; at < n; at += count) {
        count = count_to_delimiter(bytes + at, n - at);
        run_loop_once(bytes + at, count);
    }
}

/* --- the bench --- */

static struct board_config config;

/* The configuration as the bench packs it: u32 seed, u32 firmware, u8[12] uid, u16 cell_codes, u16 queue_points,
   u16 cells, u16 window_pulses, u8 key_edge, u8 inputs, then the limits as in LIMITS. */
static uint16_t get_u16(const uint8_t *at) { return (uint16_t)(at[0] | at[1] << 8); }
static uint32_t get_u32(const uint8_t *at) { return get_u16(at) | (uint32_t)get_u16(at + 2) << 16; }

static void configure(void) {
    struct command command;
    write_times('C', chip_reset_us(), 0);
    bench_read(&command);
    const uint8_t *bytes = command.bytes;
    entropy_state = get_u32(bytes);
    config.firmware = get_u32(bytes + 4);
    memcpy(config.uid, bytes + 8, 12);
    config.cell_codes = get_u16(bytes + 20);
    config.queue_points = get_u16(bytes + 22);
    config.cells = get_u16(bytes + 24);
    config.window_pulses = get_u16(bytes + 26);
    config.key_edge = bytes[28] != 0;
    inputs = bytes[29];
    const uint8_t *at = bytes + 30;
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

static void set_inputs(uint8_t value) {
    write_times('I', chip_now_us(), value);
    inputs = value;
    board_tick(&board, chip_now_us());
}

static void miss_ticks(void) {
    chip_wait_until(chip_now_us() + BOARD_TICK_LATE_US + 2u * BOARD_TICK_US);
}

static void run(const struct command *command) {
    switch (command->kind) {
    case 'U':
        run_until(command->at_us);
        break;
    case 'B':
        receive(command->bytes, command->length);
        break;
    case 'I':
        set_inputs(command->bytes[0]);
        break;
    case 'E': /* as a capture register takes it: exact, and noticed by the next tick */
        trigger_us = chip_now_us();
        triggers++;
        write_times('E', trigger_us, triggers);
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
    case 'K':
        tick_stopped = true;
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

int main(void) {
    struct command command;
    bool watchdog_reset = chip_start();
    bench_open();
    configure();
    board_init(&board, &hal, &config, watchdog_reset ? RESET_WATCHDOG : RESET_POWER_UP, chip_now_us());
    for (;;) {
        write_times('D', chip_now_us(), board_next_due_us(&board));
        bench_read(&command);
        run(&command);
    }
}
