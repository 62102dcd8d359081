/* What must hold of a board whatever is said and done to it: PROTOCOL.md's guards, stated once more over what goes into
   the core and what comes out of it. It keeps its own lists and shares no code with the core but the struct's
   declaration; where the page allows more than one answer, it takes the core's from its frames. */

#ifndef ORACLE_H
#define ORACLE_H

#include "board.h"
#include "reference.h"

#define POINTS_SEEN 512u
#define TICK_MAX_US 100u /* the driver's longest step, but for ticks that it makes late */

struct seen_pulse {
    uint64_t from_us, to_us;
    uint32_t index, account_us[4];
    uint16_t x, y, on_us, duty;
    double level_uj[4];
};

struct seen_point {
    uint32_t index;
    uint16_t x, y, dark_us, on_us, duty;
};

struct oracle {
    struct board_limits own, limits; /* the board's, and those in force */
    uint16_t cell_codes;
    bool key_edge;
    uint64_t now_us, late_us; /* late_us: ticks came so much too late, all in all */

    /* link */
    uint16_t session;
    uint8_t next_seq;
    uint32_t next_index, job;
    struct seen_point pending[24];
    uint8_t pending_type, pending_body[40];
    uint32_t pending_points;
    bool answered, changes_nothing;

    /* arming */
    bool challenged, confirmed, key_turned, fits;
    uint32_t host_nonce, board_nonce;
    uint64_t asked_us, lease_until_us, state_since_us;
    uint8_t state;
    bool cleared;

    /* inputs and outputs */
    uint8_t inputs, seen_inputs;
    uint64_t unsafe_since_us;
    bool lit, moved, relay, indicator, turned, differs, powering_up;
    uint64_t differs_since_us;

    /* points */
    struct seen_point queue[POINTS_SEEN], current;
    uint32_t queue_first, queue_count;
    bool has_current, was_lit;
    uint64_t begun_us, settled_us;
    uint16_t x, y;
    struct seen_pulse pulses[POINTS_SEEN];
    uint32_t pulses_count;
};

_Noreturn void violated(const char *guard, const char *what);

/* --- before and after the driver calls the core --- */

void oracle_power_up(struct oracle *o, const struct board_config *config, uint64_t now_us);
/* The driver is about to pass an intact frame; says in changes_nothing whether it must not matter. */
void oracle_hears(struct oracle *o, const struct parsed *frame);
void oracle_inputs_change(struct oracle *o, uint8_t inputs);
/* After each call: what may be seen at that time. */
void oracle_look(struct oracle *o, const struct board *b);
void oracle_after_tick(struct oracle *o, uint64_t since_us);

/* --- from the HAL --- */

void oracle_gate(struct oracle *o, bool on, uint16_t duty);
void oracle_mirrors(struct oracle *o, uint16_t x, uint16_t y);
void oracle_readback(struct oracle *o, bool level);
void oracle_fed(struct oracle *o);
void oracle_sent(struct oracle *o, const uint8_t *frame, size_t n);

/* B4 to B6 of a pulse that begins now; keeps it in the list. */
struct seen_pulse *power_of(struct oracle *o);

#endif
