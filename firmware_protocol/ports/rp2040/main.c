/* The board's core on a Raspberry Pi Pico: the safety tick runs in the timer interrupt, the rest in the main loop.
   docs/how-to/wire-a-board.md shows the circuit. Run in an emulator of the chip, but not yet on hardware. */

#include "board.h"
#include "chip.h"
#include "feedback.h"
#include "host_port.h"
#include "outputs.h"
#include "pins.h"
#include "settings.h"
#include "xy2_100.h"

#define LOOP_BYTES_MAX 64u
#define TEMPERATURE_UNKNOWN_DC 250 /* the ADC measures the mirrors */

static struct board board;
static const struct board_config *const volatile settings = &SETTINGS; /* read from memory: an image's may be replaced */
static uint64_t last_tick_us;

/* --- the HAL --- */

static void set_gate(void *context, bool on, uint16_t duty) {
    (void)context;
    outputs_set_gate(on, duty);
}
static bool read_gate(void *context) {
    (void)context;
    return outputs_get(PIN_READBACK);
}
static void move_mirrors(void *context, uint16_t x, uint16_t y) {
    (void)context;
    outputs_move_mirrors(settings->interface, x, y);
}
static uint8_t read_inputs(void *context) {
    (void)context;
    return (uint8_t)((outputs_get(PIN_INTERLOCK) ? INPUT_INTERLOCK : 0) | (outputs_get(PIN_KEY) ? INPUT_KEY : 0) |
                     (outputs_get(PIN_ESTOP) ? 0 : INPUT_ESTOP));
}
static bool read_head(void *context, uint16_t *status) {
    (void)context;
    return xy2_100_read_status(status);
}
static void read_position(void *context, int32_t *x, int32_t *y) {
    (void)context;
    feedback_read(x, y);
}
static uint32_t read_triggers(void *context, uint64_t *last_us) {
    (void)context;
    return chip_read_triggers(last_us);
}
static void set_indicator(void *context, bool on) {
    (void)context;
    outputs_set(PIN_INDICATOR, on);
}
static void set_relay(void *context, bool closed) {
    (void)context;
    outputs_set(PIN_RELAY, closed);
}
static uint32_t read_entropy(void *context) {
    (void)context;
    return chip_entropy();
}
static int16_t read_temperature_dc(void *context) {
    (void)context;
    return settings->feedback_codes ? TEMPERATURE_UNKNOWN_DC : chip_temperature_dc();
}
static void send(void *context, const uint8_t *frame, size_t n) {
    (void)context;
    host_send(frame, n);
}
static void discard_output(void *context) {
    (void)context;
    host_discard_output();
}
static void feed_watchdog(void *context) {
    (void)context;
    chip_feed_watchdog();
}

static void hold_tick(void *context, bool hold) {
    (void)context;
    if (hold) {
        chip_hold_alarm();
    } else {
        chip_release_alarm();
    }
}

static const struct board_hal HAL = {
    .set_gate = set_gate,
    .read_gate = read_gate,
    .move_mirrors = move_mirrors,
    .read_inputs = read_inputs,
    .read_head = read_head,
    .read_position = read_position,
    .read_triggers = read_triggers,
    .set_indicator = set_indicator,
    .set_relay = set_relay,
    .read_entropy = read_entropy,
    .read_temperature_dc = read_temperature_dc,
    .send = send,
    .discard_output = discard_output,
    .feed_watchdog = feed_watchdog,
    .hold_tick = hold_tick,
};

/* --- the tick --- */

static void set_alarm(void) {
    uint64_t next_us = last_tick_us + BOARD_TICK_US, due_us = board_next_due_us(&board);
    chip_set_alarm(due_us < next_us ? due_us : next_us);
}

static void on_alarm(void) {
    outputs_set(PIN_TICK, true);
    last_tick_us = chip_now_us();
    board_tick(&board, last_tick_us);
    set_alarm();
    outputs_set(PIN_TICK, false);
}

/* --- the loop --- */

/* Returns whether there were any bytes. The core holds the alarm where it must. */
static bool run_loop_once(void) {
    uint8_t bytes[LOOP_BYTES_MAX];
    chip_collect_entropy();
    if (host_serve()) {
        board_on_link_lost(&board, chip_now_us());
    }
    size_t n = host_read(bytes, sizeof bytes);
    board_receive(&board, bytes, n, chip_now_us());
    chip_hold_alarm();
    set_alarm();
    chip_release_alarm();
    return n > 0;
}

int main(void) {
    enum reset_cause cause = chip_reset_cause();
    chip_start(on_alarm);
    outputs_start(settings->interface);
    if (settings->feedback_codes) {
        feedback_start();
    }
    chip_start_trigger(PIN_TRIGGER);
    host_start(settings->uid);
    last_tick_us = chip_now_us();
    board_init(&board, &HAL, settings, cause, last_tick_us);
    chip_start_watchdog();
    set_alarm();
    chip_release_alarm();
    for (;;) {
        if (!run_loop_once()) {
            chip_sleep();
        }
    }
}
