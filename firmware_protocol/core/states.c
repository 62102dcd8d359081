/* State changes and their effects: gate, outputs, queue, log and EVENT. */

#include "core.h"

bool is_leased(uint8_t state) {
    return STATES_LEASED >> state & 1u;
}

uint8_t find_unsafe_inputs(uint8_t inputs) { return inputs ^ (INPUT_INTERLOCK | INPUT_KEY); }

enum fault find_input_fault(uint8_t unsafe) {
    if (MUTANT == 9 || unsafe == 0) {
        return FAULT_NONE;
    }
    return unsafe & INPUT_INTERLOCK ? FAULT_INTERLOCK : unsafe & INPUT_KEY ? FAULT_KEY : FAULT_ESTOP;
}

#define HEAD_READY 0xc000u /* power and temperature */

bool is_head_ready(const struct board *b) {
    return MUTANT == 16 || b->config.interface != INTERFACE_XY2_100 || (b->head & HEAD_READY) == HEAD_READY;
}

static bool is_near(const struct board *b, int32_t measured, uint16_t commanded) {
    int32_t codes = measured > commanded ? measured - commanded : commanded - measured;
    return codes <= b->config.feedback_codes;
}

bool measure_mirrors(struct board *b, uint64_t now_us) {
    if (b->config.feedback_codes == 0) {
        return true;
    }
    b->hal.read_position(b->hal.context, &b->measured_x, &b->measured_y);
    if (now_us >= b->settled_us) {
        b->follows = MUTANT == 17 || (is_near(b, b->measured_x, b->x) && is_near(b, b->measured_y, b->y));
    }
    return b->follows;
}

enum fault find_unsafe(struct board *b) {
    enum fault fault = find_input_fault(find_unsafe_inputs(b->inputs));
    if (fault == FAULT_NONE && !is_head_ready(b)) {
        return FAULT_HEAD;
    }
    return fault == FAULT_NONE && MUTANT != 111 && !measure_mirrors(b, b->now_us) ? FAULT_SCAN : fault;
}

size_t encode_message(const struct board *b, uint8_t *wire, uint8_t type, const uint8_t *body, size_t n) {
    return b->link.session ? frame_encode(wire, type, 0, b->link.session, body, n) : 0;
}

void send_message(struct board *b, uint8_t type, const uint8_t *body, size_t n) {
    uint8_t wire[WIRE_MAX];
    size_t length = encode_message(b, wire, type, body, n);
    if (length > 0) {
        b->hal.send(b->hal.context, wire, length);
    }
}

void drop_queue(struct board *b) {
    b->queue.count = 0;
    b->job.active = false;
    b->done_index = b->next_index;
}

static void trace(struct board *b, struct board_trace event) {
    if (b->hal.trace) {
        event.at_us = b->now_us;
        b->hal.trace(b->hal.context, &event);
    }
}

void command_gate(struct board *b, bool on, uint16_t duty) {
    b->gate = on;
    b->hal.set_gate(b->hal.context, on, on ? duty : 0);
}

void trace_gate(struct board *b, bool on, bool is_point, uint32_t index_or_reason) {
    trace(b, (struct board_trace){.kind = TRACE_GATE, .on = on, .is_point = is_point,
                                  .index = is_point ? index_or_reason : 0,
                                  .reason = is_point ? 0 : (uint8_t)index_or_reason});
}

/* Records the execution of the current point. */
void record_execution(struct board *b, uint64_t on_at_us, uint64_t on_us) {
    const struct point *point = &b->current_point;
    struct record record = {.number = b->current_index, .on_tick = on_at_us - b->epoch_us};
    record.on_ticks = on_us > UINT16_MAX ? UINT16_MAX : (uint16_t)on_us;
    record.duty = on_us ? point->duty : 0;
    records_add(&b->records, &record);
    b->done_index = b->current_index + 1;
    b->laser_on_duty_us += on_us * point->duty;
    if (on_us) {
        trace(b, (struct board_trace){.kind = TRACE_PULSE, .index = b->current_index, .x = point->x, .y = point->y,
                                      .duty = point->duty, .on_us = on_at_us, .off_us = on_at_us + on_us});
    }
}

/* Turns the gate off and records what an interrupted pulse emitted. */
static void close_gate(struct board *b, enum reason reason) {
    bool gate_was_on = b->gate;
    if (MUTANT != 1) {
        command_gate(b, false, 0);
    }
    if (MUTANT != 1 && gate_was_on) {
        trace_gate(b, false, false, reason);
    }
    if (b->has_current_point && gate_was_on) {
        record_execution(b, b->gate_on_us, b->now_us - b->gate_on_us);
    }
    b->has_current_point = false;
}

struct transition {
    uint8_t to;
    bool drops;
};

/* Returns what an event leads to; FAULT if the table has no such transition, which no caller causes. */
static struct transition find_transition(uint8_t state, enum reason event) {
#define TRANSITION(from, reason, next, drops_all) \
    if (state == (from) && event == (reason)) { \
        return (struct transition){.to = (next), .drops = (drops_all)}; \
    }
    STATE_TRANSITIONS(TRANSITION)
#undef TRANSITION
    return (struct transition){.to = STATE_FAULT, .drops = true};
}

void change_state(struct board *b, enum reason event) {
    struct transition next = find_transition(b->state, event);
    if (next.to != STATE_RUNNING) {
        close_gate(b, event);
    }
    uint8_t before = b->state, body[EVENT_SIZE];
    b->state = next.to;
    b->hal.set_indicator(b->hal.context, is_leased(b->state));
    b->hal.set_relay(b->hal.context, next.to != STATE_FAULT);
    trace(b, (struct board_trace){.kind = TRACE_STATE, .state = b->state, .before = before, .reason = (uint8_t)event});
    body[EVENT_STATE_AT] = b->state;
    body[EVENT_FAULT_AT] = b->fault;
    body[EVENT_REASON_AT] = (uint8_t)event;
    put_u64(body + EVENT_TICK_AT, b->now_us - b->epoch_us);
    send_message(b, MESSAGE_EVENT, body, sizeof body);
    if (next.drops) {
        drop_queue(b);
    }
}

void disarm(struct board *b, enum reason reason) {
    b->confirmed = b->nonce_valid = false;
    if (STATES_IDLE >> b->state & 1u) {
        drop_queue(b);
    } else {
        change_state(b, reason);
    }
}

void enter_fault(struct board *b, enum fault fault) {
    if (b->state != STATE_FAULT) {
        b->fault = (uint8_t)fault;
        trace(b, (struct board_trace){.kind = TRACE_FAULT, .fault = b->fault});
        change_state(b, REASON_FAULT);
    }
    b->confirmed = b->nonce_valid = false;
}
