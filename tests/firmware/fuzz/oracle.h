/* Test oracle: PROTOCOL.md's guards as conditions on the inputs and outputs of the core. It keeps its own state and
   shares only the struct declarations with the core. Where PROTOCOL.md permits several answers, it follows the one in
   the core's frames. */

#ifndef ORACLE_H
#define ORACLE_H

#include "board.h"
#include "reference.h"

#define POINTS_MAX 512u
#define TICK_MAX_US 100u /* longest time step of the driver, except for late ticks */

struct observed_pulse {
    uint64_t from_us, to_us;
    uint32_t index, account_us[4];
    uint16_t x, y, on_us, duty;
    double level_uj[4];
};

struct observed_point {
    uint32_t index;
    uint16_t x, y, dark_us, on_us, duty;
};

#define HEAD_READY 8u /* beside the inputs: the scan head says that power and temperature are in order */

struct oracle {
    struct board_limits own, limits; /* the board's own limits, and the limits in force */
    uint16_t cell_codes;
    bool key_edge;
    uint64_t now_us, late_us; /* late_us: total lateness of all ticks */

    /* link */
    uint16_t session;
    uint8_t next_seq;
    uint32_t next_index, job;
    struct observed_point pending[24];
    uint8_t pending_type, pending_body[40];
    uint32_t pending_points;
    bool answered, changes_nothing;

    /* arming */
    bool challenged, confirmed, key_turned, version_supported;
    uint32_t host_nonce, board_nonce;
    uint64_t arming_since_us, lease_until_us, state_since_us;
    uint8_t state;
    bool cleared;

    /* inputs and outputs */
    uint8_t inputs, observed_inputs;
    uint64_t unsafe_since_us;
    bool gate_on, moved, relay, indicator, loop_ran, differs, powering_up;
    uint64_t differs_since_us;

    /* points */
    struct observed_point queue[POINTS_MAX], current;
    uint32_t queue_first, queue_count;
    bool has_current, was_on;
    uint64_t start_us, settled_us;
    uint16_t x, y;
    struct observed_pulse pulses[POINTS_MAX];
    uint32_t pulses_count;
};

_Noreturn void report_violation(const char *guard, const char *what);

/* --- before and after the driver calls the core --- */

void oracle_power_up(struct oracle *o, const struct board_config *config, uint64_t now_us);
/* Call before an intact frame is passed; sets changes_nothing if the frame must have no effect. */
void oracle_on_frame(struct oracle *o, const struct parsed *frame);
void oracle_inputs_change(struct oracle *o, uint8_t inputs);
/* Call after each call of the core: checks the visible state. */
void oracle_check(struct oracle *o, const struct board *b);
void oracle_after_tick(struct oracle *o, uint64_t since_us);

/* --- from the HAL --- */

void oracle_on_gate(struct oracle *o, bool on, uint16_t duty);
void oracle_on_mirrors(struct oracle *o, uint16_t x, uint16_t y);
void oracle_on_readback(struct oracle *o, bool level);
void oracle_on_feed(struct oracle *o);
void oracle_on_send(struct oracle *o, const uint8_t *frame, size_t n);

/* Checks B4 to B6 for a pulse that begins now, and adds it to the list. */
struct observed_pulse *check_pulse_power(struct oracle *o);

#endif
