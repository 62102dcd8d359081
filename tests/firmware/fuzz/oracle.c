#include "oracle.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define SAFE (INPUT_INTERLOCK | INPUT_KEY | HEAD_READY)

void report_violation(const char *guard, const char *what) {
    fprintf(stderr, "oracle: %s: %s\n", guard, what);
    abort();
}

static void require(bool holds, const char *guard, const char *what) {
    if (!holds) {
        report_violation(guard, what);
    }
}

static bool is_leased(uint8_t state) { return state >= STATE_ARMING && state <= STATE_HOLD; }

static uint16_t u16(const uint8_t *at) { return (uint16_t)read_le(at, 2); }
static uint32_t u32(const uint8_t *at) { return (uint32_t)read_le(at, 4); }

/* --- limits --- */

#define LESS_OF(name, requested) now->name = now->name < (requested) ? now->name : (requested)
#define MORE_OF(name, requested) now->name = now->name > (requested) ? now->name : (requested)

static void tighten(struct board_limits *now, const uint8_t *body) {
    LESS_OF(max_on_us, u16(body));
    LESS_OF(max_duty, u16(body + 2));
    LESS_OF(mean_duty, u16(body + 4));
    LESS_OF(spot_uj, u32(body + 6));
    LESS_OF(spot_leak_uw, u32(body + 10));
    MORE_OF(x_min, u16(body + 18));
    LESS_OF(x_max, u16(body + 20));
    MORE_OF(y_min, u16(body + 22));
    LESS_OF(y_max, u16(body + 24));
    MORE_OF(settle_us, u16(body + 26));
    MORE_OF(settle_ns_per_code, u16(body + 28));
    MORE_OF(rest_us, u16(body + 30));
    LESS_OF(lease_ms, u16(body + 32));
}

/* --- power-up --- */

static void forget_points(struct oracle *o) {
    o->queue_count = 0;
    o->has_current = false;
}

void oracle_power_up(struct oracle *o, const struct board_config *config, uint64_t now_us) {
    struct oracle fresh = {.own = config->limits, .limits = config->limits, .cell_codes = config->cell_codes,
                           .key_edge = config->key_edge, .now_us = now_us, .state = STATE_DISARMED,
                           .state_since_us = now_us, .inputs = o->inputs, .observed_inputs = o->inputs,
                           .unsafe_since_us = o->unsafe_since_us, .powering_up = true};
    /* A reset does not change the physical state: mirror position and gate. */
    fresh.x = o->x;
    fresh.y = o->y;
    fresh.gate_on = o->gate_on;
    *o = fresh;
}

/* --- inputs --- */

void oracle_inputs_change(struct oracle *o, uint8_t inputs) {
    o->key_turned = o->key_turned || (inputs & ~o->inputs & INPUT_KEY);
    if (o->inputs == SAFE && inputs != SAFE) {
        o->unsafe_since_us = o->now_us;
    }
    o->inputs = inputs;
}

/* --- messages from the host --- */

static void on_sequenced_frame(struct oracle *o, const struct parsed *frame) {
    if (frame->seq != o->next_seq) {
        return; /* a duplicate or a gap must not be carried out */
    }
    o->pending_type = frame->type;
    if (frame->type == 0x10) {
        o->pending_points = (uint32_t)(frame->length - 4) / 10;
        for (uint32_t k = 0; k < o->pending_points; k++) {
            const uint8_t *at = frame->body + 4 + 10 * k;
            o->pending[k] = (struct observed_point){u32(frame->body) + k, u16(at), u16(at + 2),
                                                u16(at + 4), u16(at + 6), u16(at + 8)};
        }
    } else if (frame->length) {
        memcpy(o->pending_body, frame->body, frame->length);
    }
}

void oracle_on_frame(struct oracle *o, const struct parsed *frame) {
    o->pending_type = 0;
    o->cleared = false;
    bool any_session = frame->type == 0x01 || frame->type == 0x13;
    o->changes_nothing = !reference_is_valid(frame) || frame->type >= 0x80 ||
                         (!any_session && (o->session == 0 || frame->session != o->session));
    if (o->changes_nothing) {
        return;
    }
    if (frame->type == 0x01) {
        o->version_supported = frame->body[0] == PROTOCOL_MAJOR;
    } else if (frame->type == 0x04 && is_leased(o->state)) {
        uint16_t ms = u16(frame->body) < o->limits.lease_ms ? u16(frame->body) : o->limits.lease_ms;
        uint64_t until_us = o->now_us + 1000u * (uint64_t)ms;
        o->lease_until_us = until_us > o->lease_until_us ? until_us : o->lease_until_us;
    } else if (reference_is_sequenced(frame->type)) {
        on_sequenced_frame(o, frame);
    }
}

/* --- messages from the board --- */

static void on_points_accepted(struct oracle *o) {
    uint32_t first = o->pending[0].index;
    require(first >= o->next_index, "B12", "points are taken again");
    require(first == o->next_index || o->queue_count == 0, "B12", "points are left out");
    for (uint32_t k = 0; k < o->pending_points; k++) {
        require(o->queue_count < POINTS_MAX, "queue", "more points than there is room for");
        o->queue[(o->queue_first + o->queue_count++) % POINTS_MAX] = o->pending[k];
    }
    o->next_index = first + o->pending_points;
}

static void on_accepted(struct oracle *o) {
    switch (o->pending_type) {
    case 0x02:
        tighten(&o->limits, o->pending_body);
        break;
    case 0x10:
        on_points_accepted(o);
        break;
    case 0x14:
        require(o->version_supported, "B11", "arms for another major version");
        require(o->observed_inputs == SAFE, "B9", "arms though an input is not safe");
        require(!o->key_edge || o->key_turned, "B11", "arms without the key being turned");
        require(o->challenged && o->host_nonce == u32(o->pending_body), "B11", "arms without a challenge");
        o->arming_since_us = o->now_us;
        o->lease_until_us = o->now_us + 1000u * (uint64_t)o->limits.lease_ms;
        break;
    case 0x15:
        require(o->challenged && u32(o->pending_body) == o->host_nonce && u32(o->pending_body + 4) == o->board_nonce,
             "B11", "a confirmation that does not echo the challenge");
        o->confirmed = true;
        o->key_turned = false;
        break;
    case 0x17:
        require(o->observed_inputs == SAFE, "B9", "a fault is cleared though an input is not safe");
        o->cleared = true;
        break;
    case 0x19:
        forget_points(o);
        break;
    default:
        break;
    }
}

static void on_answer(struct oracle *o, bool carried_out, uint8_t next_seq) {
    if (o->pending_type && carried_out) {
        on_accepted(o);
    }
    if (o->pending_type == 0x15) {
        o->challenged = false; /* valid for one confirmation */
    }
    o->pending_type = 0;
    o->next_seq = next_seq;
}

static void on_session(struct oracle *o, const struct parsed *frame) {
    uint16_t session = u16(frame->body + 6);
    require(session != 0 && session != o->session, "HELLO", "a session's number is 0 or the last one's");
    o->session = session;
    o->next_seq = 0;
    o->next_index = 0;
    o->limits = o->own;
    o->confirmed = o->challenged = false;
    forget_points(o);
}

static const struct observed_pulse *pulse_of(const struct oracle *o, uint32_t index, uint16_t duty) {
    for (uint32_t k = o->pulses_count; k-- > 0;) {
        if (o->pulses[k].index == index && o->pulses[k].duty == duty) {
            return &o->pulses[k];
        }
    }
    return NULL;
}

/* A report must match the observed gate edges. */
static void check_report(const struct oracle *o, const struct parsed *frame) {
    for (size_t at = 12, k = 0; at < frame->length; at += 8, k++) {
        uint16_t on_ticks = u16(frame->body + at + 4), duty = u16(frame->body + at + 6);
        if (on_ticks == 0) {
            continue;
        }
        const struct observed_pulse *pulse = pulse_of(o, u32(frame->body) + (uint32_t)k, duty);
        require(pulse && pulse->to_us, "EXECUTED", "a pulse that never was");
        uint64_t seen_us = pulse->to_us - pulse->from_us;
        uint64_t apart_us = seen_us > on_ticks ? seen_us - on_ticks : on_ticks - seen_us;
        require(apart_us <= o->late_us || on_ticks == UINT16_MAX, "EXECUTED", "another duration than was seen");
    }
}

void oracle_on_send(struct oracle *o, const uint8_t *bytes, size_t n) {
    uint8_t raw[REFERENCE_RAW_MAX];
    struct parsed frame;
    require(n > 1 && bytes[n - 1] == 0 && !memchr(bytes, 0, n - 1), "framing", "not one frame and its zero");
    require(reference_decode(bytes, n - 1, raw, &frame) == READ_FRAME && reference_is_valid(&frame) && frame.type >= 0x80,
         "framing", "the board sends what is no message of a board");
    o->answered = true;
    switch (frame.type) {
    case 0x81:
        on_session(o, &frame);
        break;
    case 0x90:
        on_answer(o, true, frame.body[0]);
        break;
    case 0x91:
        on_answer(o, false, frame.body[0]);
        break;
    case 0x92: /* HOLD may be left and entered again within one call */
        o->state_since_us = frame.body[0] == STATE_HOLD ? o->now_us : o->state_since_us;
        break;
    case 0x94:
        o->challenged = true;
        o->host_nonce = u32(frame.body);
        o->board_nonce = u32(frame.body + 4);
        break;
    case 0x99:
        check_report(o, &frame);
        break;
    default:
        break;
    }
}

/* --- gate and mirrors --- */

static uint64_t slack_us(const struct oracle *o) { return o->late_us; }

static void on_gate_on(struct oracle *o, uint16_t duty) {
    const struct observed_point *point = &o->current;
    const struct board_limits *limits = &o->limits;
    require(!o->gate_on, "B1", "lit twice");
    require(o->has_current && !o->was_on && point->on_us > 0, "B12", "light without a point, or a second time");
    require(duty == point->duty && duty <= limits->max_duty, "B5", "another duty than the point's, or too much");
    require(point->on_us <= limits->max_on_us, "B4", "a point longer than may be");
    require(point->x >= limits->x_min && point->x <= limits->x_max && point->y >= limits->y_min && point->y <= limits->y_max,
         "B8", "light outside the field");
    require(o->now_us + slack_us(o) >= o->start_us + point->dark_us, "B7", "light before the dark time is over");
    require(o->now_us + slack_us(o) >= o->settled_us, "B7", "light before the mirrors stand");
    require(o->now_us <= o->lease_until_us + slack_us(o), "B3", "light begins after the lease");
    o->was_on = true;
    check_pulse_power(o);
}

void oracle_on_gate(struct oracle *o, bool on, uint16_t duty) {
    if (on) {
        on_gate_on(o, duty);
    } else if (o->gate_on && o->pulses_count) {
        o->pulses[o->pulses_count - 1].to_us = o->now_us;
    }
    o->gate_on = on;
}

void oracle_on_mirrors(struct oracle *o, uint16_t x, uint16_t y) {
    require(!o->gate_on, "B7", "mirrors move under light");
    uint32_t along_x = x > o->x ? x - o->x : o->x - x, along_y = y > o->y ? y - o->y : o->y - y;
    uint64_t codes = along_x > along_y ? along_x : along_y;
    o->x = x;
    o->y = y;
    if (o->powering_up) {
        return; /* the arming time exceeds any return to centre */
    }
    require(o->queue_count > 0, "B12", "mirrors move without a point");
    o->current = o->queue[o->queue_first % POINTS_MAX];
    o->queue_first = (o->queue_first + 1) % POINTS_MAX;
    o->queue_count--;
    require(o->current.x == x && o->current.y == y, "B12", "not the point that comes next");
    o->has_current = true;
    o->was_on = false;
    o->start_us = o->now_us;
    if (codes) {
        uint64_t from_us = o->settled_us > o->now_us ? o->settled_us : o->now_us;
        o->settled_us = from_us + o->limits.settle_us + (codes * o->limits.settle_ns_per_code + 999) / 1000;
    }
}

/* --- self-checks of the board --- */

void oracle_on_readback(struct oracle *o, bool level) {
    if (level != o->gate_on && !o->differs) {
        o->differs_since_us = o->now_us;
    }
    o->differs = level != o->gate_on;
}

void oracle_on_feed(struct oracle *o) {
    require(o->loop_ran, "B15", "the watchdog is fed though the loop stands still");
    o->loop_ran = false;
}

void oracle_after_tick(struct oracle *o, uint64_t since_us) {
    o->observed_inputs = o->inputs;
    require(since_us <= 600 || o->state == STATE_FAULT, "B14", "a late tick is no fault");
    require(!o->differs || o->now_us <= o->differs_since_us + 100 || o->state == STATE_FAULT, "B14",
         "the gate's readback differs and is no fault");
}

/* --- after each call --- */

static void on_state_change(struct oracle *o, uint8_t state) {
    uint64_t armed_us = o->arming_since_us + INDICATOR_US;
    bool ends = state == STATE_DISARMED || state == STATE_FAULT;
    if (o->state == STATE_ARMING && (is_leased(state) && state != STATE_ARMING)) {
        require(o->confirmed && o->now_us >= armed_us, "B11", "armed too soon, or without a confirmation");
    }
    require(is_leased(o->state) || !is_leased(state) || state == STATE_ARMING, "B11", "armed without a request");
    require(o->state != STATE_FAULT || o->cleared, "fault", "left without being cleared");
    if (ends) {
        forget_points(o);
        o->confirmed = o->challenged = false;
    }
    o->state = state;
    o->state_since_us = o->now_us;
    o->cleared = false;
}

static void limits_are(const struct board_limits *a, const struct board_limits *b) {
    require(a->max_on_us == b->max_on_us && a->max_duty == b->max_duty && a->mean_duty == b->mean_duty &&
             a->spot_uj == b->spot_uj && a->spot_leak_uw == b->spot_leak_uw && a->full_power_uw == b->full_power_uw &&
             a->x_min == b->x_min && a->x_max == b->x_max && a->y_min == b->y_min && a->y_max == b->y_max &&
             a->settle_us == b->settle_us && a->settle_ns_per_code == b->settle_ns_per_code &&
             a->rest_us == b->rest_us && a->lease_ms == b->lease_ms,
         "B10", "limits that are not the tighter ones");
}

void oracle_check(struct oracle *o, const struct board *b) {
    o->powering_up = false;
    if (b->state != o->state) {
        on_state_change(o, b->state);
    } else if (o->state == STATE_DISARMED || o->state == STATE_FAULT) {
        forget_points(o);
    }
    require(b->state < STATE_COUNT && b->state != STATE_BOOT, "states", "none that is known");
    require(!o->gate_on || o->state == STATE_RUNNING, "B1", "lit outside RUNNING");
    require(o->relay == (o->state != STATE_FAULT), "fault", "the relay is not as the state says");
    require(o->indicator == is_leased(o->state), "arming", "the indicator is not as the state says");
    require(!is_leased(o->state) || o->now_us < o->lease_until_us + TICK_MAX_US + slack_us(o), "B3", "no lease");
    require(!is_leased(o->state) || o->inputs == SAFE || o->now_us <= o->unsafe_since_us + 1000 + slack_us(o), "B9",
         "goes on though an input is not safe");
    require(o->state != STATE_HOLD || o->now_us <= o->state_since_us + HOLD_MAX_US + TICK_MAX_US + slack_us(o), "HOLD",
         "lasts too long");
    require(o->state != STATE_ARMING || o->now_us <= o->arming_since_us + ARMING_TIMEOUT_US + TICK_MAX_US + slack_us(o), "ARMING",
         "lasts too long");
    if (o->gate_on) {
        require(o->now_us <= o->pulses[o->pulses_count - 1].from_us + o->current.on_us + TICK_MAX_US + slack_us(o), "B2",
             "lit for longer than the point says");
    }
    limits_are(&b->limits, &o->limits);
}
