/* The board's core on a Raspberry Pi Pico: the safety tick from the timer's interrupt, everything else from the loop.
   docs/how-to/wire-a-board.md has the circuit. Compiled, and never yet run on hardware. */

#include "board.h"
#include "chip.h"
#include "outputs.h"
#include "pins.h"
#include "settings.h"

#define TURN_BYTES 64u

static struct board board;
static uint64_t ticked_us;

/* --- the HAL --- */

static void gate(void *context, bool on, uint16_t duty) {
    (void)context;
    outputs_gate(on, duty);
}
static bool gate_readback(void *context) {
    (void)context;
    return outputs_get(PIN_READBACK);
}
static void mirrors(void *context, uint16_t x, uint16_t y) {
    (void)context;
    outputs_mirrors(x, y);
}
static uint8_t inputs(void *context) {
    (void)context;
    return (uint8_t)((outputs_get(PIN_INTERLOCK) ? INPUT_INTERLOCK : 0) | (outputs_get(PIN_KEY) ? INPUT_KEY : 0) |
                     (outputs_get(PIN_ESTOP) ? 0 : INPUT_ESTOP));
}
static void indicator(void *context, bool lit) {
    (void)context;
    outputs_set(PIN_INDICATOR, lit);
}
static void relay(void *context, bool closed) {
    (void)context;
    outputs_set(PIN_RELAY, closed);
}
static uint32_t entropy(void *context) {
    (void)context;
    return chip_entropy();
}
static int16_t temperature_dc(void *context) {
    (void)context;
    return chip_temperature_dc();
}
static void send(void *context, const uint8_t *frame, size_t n) {
    (void)context;
    chip_send(frame, n);
}
static void forget(void *context) {
    (void)context;
    chip_forget();
}
static void feed_watchdog(void *context) {
    (void)context;
    chip_feed_watchdog();
}

static const struct board_hal HAL = {
    .gate = gate,
    .gate_readback = gate_readback,
    .mirrors = mirrors,
    .inputs = inputs,
    .indicator = indicator,
    .relay = relay,
    .entropy = entropy,
    .temperature_dc = temperature_dc,
    .send = send,
    .forget = forget,
    .feed_watchdog = feed_watchdog,
};

/* --- the tick --- */

static void set_alarm(void) {
    uint64_t next_us = ticked_us + BOARD_TICK_US, due_us = board_next_due_us(&board);
    chip_alarm(due_us < next_us ? due_us : next_us);
}

void on_alarm(void) {
    outputs_set(PIN_TICK, true);
    ticked_us = chip_now_us();
    board_tick(&board, ticked_us);
    set_alarm();
    outputs_set(PIN_TICK, false);
}

/* --- the loop --- */

/* A port that no program has open is told once, and what comes from it then is nobody's. */
static bool host_left(void) {
    static bool was_closed = true;
    bool closed = outputs_get(PIN_HOST_CLOSED), left = closed && !was_closed;
    was_closed = closed;
    return chip_break() || left;
}

/* The alarm is held for as long as the bytes of one turn take: a few at a time. */
static void turn(void) {
    uint8_t bytes[TURN_BYTES];
    size_t n = chip_read(bytes, sizeof bytes);
    bool left = host_left();
    chip_stir();
    chip_hold_alarm();
    if (left) {
        board_link_lost(&board, chip_now_us());
    }
    board_receive(&board, bytes, outputs_get(PIN_HOST_CLOSED) ? 0 : n, chip_now_us());
    set_alarm();
    chip_release_alarm();
}

int main(void) {
    enum reset_cause cause = chip_reset_cause();
    chip_start();
    outputs_start();
    ticked_us = chip_now_us();
    board_init(&board, &HAL, &SETTINGS, cause, ticked_us);
    chip_start_watchdog();
    set_alarm();
    chip_release_alarm();
    for (;;) {
        turn();
    }
}
