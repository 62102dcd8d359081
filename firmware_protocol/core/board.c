/* Entry points of the core: power-up, safety tick and main loop. */

#include <string.h>

#include "core.h"

#define NEVER UINT64_MAX

/* --- due events, in this order if several are due at the same time --- */

static uint64_t lease_due_us(const struct board *b) {
#if MUTANT == 3
    return NEVER;
#endif
    return is_leased(b->state) ? b->lease_until_us : NEVER;
}

static uint64_t arming_due_us(const struct board *b) {
    if (b->state != STATE_ARMING) {
        return NEVER;
    }
    return b->arming_since_us + (b->confirmed ? INDICATOR_US : ARMING_TIMEOUT_US);
}

static uint64_t hold_due_us(const struct board *b) {
    if (b->state == STATE_HOLD) {
        return b->hold_since_us + HOLD_MAX_US;
    }
    if (b->state != STATE_RUNNING || b->has_current_point || !b->job.active) {
        return NEVER;
    }
    if (b->job.awaits_trigger) {
        return MUTANT == 108 ? NEVER : b->job.start_us;
    }
    return has_enough_points(b) ? NEVER : b->job.start_us + HOLD_MAX_US;
}

static uint64_t point_due_us(const struct board *b) {
    if (b->state != STATE_RUNNING) {
        return NEVER;
    }
    if (b->has_current_point) {
        return b->due_us;
    }
    if (b->job.awaits_trigger || !has_enough_points(b)) {
        return NEVER;
    }
    return b->job.start_us > b->now_us ? b->job.start_us : b->now_us;
}

uint64_t board_next_due_us(const struct board *b) {
    uint64_t due[] = {lease_due_us(b), arming_due_us(b), hold_due_us(b), point_due_us(b)}, next = NEVER;
    for (size_t k = 0; k < sizeof due / sizeof due[0]; k++) {
        next = due[k] < next ? due[k] : next;
    }
    return next;
}

static void run_due_event(struct board *b) {
    if (lease_due_us(b) <= b->now_us) {
        enter_fault(b, FAULT_LINK);
    } else if (arming_due_us(b) <= b->now_us) {
        if (b->confirmed) {
            change_state(b, REASON_ARMED);
        } else {
            disarm(b, REASON_ARMING_TIMED_OUT);
        }
    } else if (hold_due_us(b) <= b->now_us) {
        disarm(b, REASON_HOLD_TOO_LONG);
    } else {
        advance_point(b);
    }
}

/* B14: a fault of the board itself turns the gate off at once, before any due event is carried out. */
static void enter_fault_at(struct board *b, enum fault fault, uint64_t now_us) {
#if MUTANT != 14
    b->now_us = now_us > b->now_us ? now_us : b->now_us;
    enter_fault(b, fault);
#else
    (void)b, (void)fault, (void)now_us;
#endif
}

/* Ticks are late from the first one on: clearing the tables takes a chip milliseconds. */
static void watch_lateness(struct board *b, uint64_t now_us) {
    if (b->has_ticked && now_us > b->last_tick_us + BOARD_TICK_US + BOARD_TICK_LATE_US) {
        enter_fault_at(b, FAULT_TICK, now_us);
    }
}

/* Carries out each event due up to now_us, in order and at its exact time, unless the tick that should have carried it
   out is late: the main loop may come before it. */
static void advance(struct board *b, uint64_t now_us) {
    if (MUTANT != 104) {
        watch_lateness(b, now_us);
    }
    for (uint64_t due_us; (due_us = board_next_due_us(b)) <= now_us && due_us != NEVER;) {
        b->now_us = due_us > b->now_us ? due_us : b->now_us;
        run_due_event(b);
    }
    b->now_us = now_us > b->now_us ? now_us : b->now_us;
}

/* --- the safety tick --- */

/* B9: an input that becomes unsafe is a fault; one that is unsafe at power-up only prevents arming. Returns the fault. */
static enum fault watch_inputs(struct board *b) {
    uint8_t inputs = b->hal.read_inputs(b->hal.context) & (INPUT_INTERLOCK | INPUT_KEY | INPUT_ESTOP);
    uint8_t became_unsafe = (uint8_t)(find_unsafe_inputs(inputs) & ~find_unsafe_inputs(b->inputs));
    b->key_turned = b->key_turned || (inputs & ~b->inputs & INPUT_KEY);
    b->inputs = inputs;
    return find_input_fault(became_unsafe);
}

/* B16: a head that ceases to be ready is a fault; one that is not ready at power-up only prevents arming. Returns the fault. */
static enum fault watch_head(struct board *b, uint64_t now_us) {
    if (b->config.interface != INTERFACE_XY2_100) {
        return FAULT_NONE;
    }
    bool was_ready = is_head_ready(b);
    uint16_t status;
    if (b->hal.read_head(b->hal.context, &status)) {
        b->head = status;
        b->head_us = now_us;
    } else if (now_us - b->head_us > BOARD_HEAD_US) {
        b->head = 0;
    }
    return was_ready && !is_head_ready(b) ? FAULT_HEAD : FAULT_NONE;
}

/* B17: a mirror that ceases to follow is a fault; one that does not follow at power-up only prevents arming. Returns the fault. */
static enum fault watch_mirrors(struct board *b, uint64_t now_us) {
    bool followed = b->follows;
    return !measure_mirrors(b, now_us) && followed && MUTANT != 112 ? FAULT_SCAN : FAULT_NONE;
}

/* Starts the job that awaits an edge, if one came since its START_ON_TRIGGER. Several edges between two ticks count, but only
   the last one has a time. */
static void watch_trigger(struct board *b, uint64_t now_us) {
    uint32_t count = b->hal.read_triggers(b->hal.context, &b->trigger_us);
    bool came = count != b->triggers_read;
    b->triggers_read = count;
    uint64_t edge_us = MUTANT == 109 ? now_us : b->trigger_us; /* may follow now_us: it came since this tick began */
    bool waited = b->job.awaits_trigger && edge_us < b->job.start_us;
    if (came && b->job.active && (waited || MUTANT == 110) && (edge_us >= b->job.accepted_us || MUTANT == 107)) {
        b->job.awaits_trigger = false;
        b->job.start_us = edge_us + b->job.delay_us;
    }
}

static void watch_tick(struct board *b, uint64_t now_us) {
    watch_lateness(b, now_us);
    b->last_tick_us = now_us > b->last_tick_us ? now_us : b->last_tick_us;
    b->has_ticked = true;
}

/* Runs before this tick changes the command, so that a gate in transition is not compared. A gate that is stuck agrees
   with one of its two commands, which says nothing about the other: the time of short dark gaps adds up. */
static void watch_readback(struct board *b, uint64_t now_us) {
    bool differs = b->hal.read_gate(b->hal.context) != b->gate;
    uint64_t *differs_us = &b->readback_differs_us[b->gate];
    if (differs && b->readback_differs) {
        *differs_us += now_us - b->readback_at_us;
    } else if (!differs) {
        *differs_us = 0;
        if (MUTANT == 106) {
            b->readback_differs_us[!b->gate] = 0;
        }
    }
    b->readback_differs = differs;
    b->readback_at_us = now_us;
    if (differs && *differs_us > BOARD_READBACK_US) {
        enter_fault_at(b, FAULT_READBACK, now_us);
    }
}

/* Inputs, head and mirrors are read before points are carried out, so that no pulse begins in the tick that sees an unsafe one. */
void board_tick(struct board *b, uint64_t now_us) {
    watch_tick(b, now_us);
    watch_readback(b, now_us);
    enum fault input_fault = watch_inputs(b), head_fault = watch_head(b, now_us), scan_fault = watch_mirrors(b, now_us);
    watch_trigger(b, now_us);
    advance(b, now_us);
    enum fault fault = input_fault != FAULT_NONE ? input_fault : head_fault != FAULT_NONE ? head_fault : scan_fault;
    if (fault != FAULT_NONE) {
        enter_fault(b, fault);
    }
    guards_tick(&b->guards, &b->limits, &b->config, b->now_us);
#if MUTANT != 15
    if (b->loop_ran)
#endif
    {
        b->hal.feed_watchdog(b->hal.context);
    }
    b->loop_ran = false;
}

/* --- the main loop: the tick may interrupt it wherever it does not hold it, above all while it sums up bytes --- */

static void hold_tick(struct board *b, bool hold) {
    if (b->hal.hold_tick) {
        b->hal.hold_tick(b->hal.context, hold);
    }
}

static void advance_held(struct board *b, uint64_t now_us) {
    hold_tick(b, true);
    advance(b, now_us);
    hold_tick(b, false);
}

/* Takes one report of records; returns its length, 0 if there are none. */
static size_t take_report(struct board *b, uint8_t *body) {
    size_t length;
    hold_tick(b, true);
    if (b->records.reported < records_oldest(&b->records)) {
        b->records.reported = records_oldest(&b->records);
    }
    size_t count = records_report(&b->records, b->records.reported, body, &length);
    b->records.reported += (uint32_t)count;
    hold_tick(b, false);
    return count > 0 ? length : 0;
}

static void send_reports(struct board *b) {
    uint8_t body[BODY_MAX], wire[WIRE_MAX];
    for (size_t length; (length = take_report(b, body)) > 0;) {
        size_t n = encode_message(b, wire, MESSAGE_EXECUTED, body, length);
        hold_tick(b, true);
        if (n > 0) {
            b->hal.send(b->hal.context, wire, n);
        }
        hold_tick(b, false);
    }
}

static void send_nak(struct board *b, uint8_t reason) {
    uint8_t body[NAK_SIZE];
    body[NAK_NEXT_SEQ_AT] = b->link.expected;
    body[NAK_REASON_AT] = reason;
    send_message(b, MESSAGE_NAK, body, sizeof body);
}

static void handle_sequenced(struct board *b, const struct frame *frame) {
    uint8_t refusal;
    if (link_accept(&b->link, frame->seq, &refusal)) {
        refusal = dispatch_sequenced(b, frame);
        if (refusal != NAK_NO_ROOM) {
            link_mark_consumed(&b->link, refusal);
        }
    }
    if (refusal == NO_REFUSAL) {
        b->link.ack_due = true;
    } else {
        send_nak(b, refusal);
    }
}

static void handle_frame(struct board *b, const struct frame *frame) {
    enum frame_class class;
    if (!frame_is_valid(frame, &class)) {
        b->link.receiver.format_errors++;
    } else if (frame->type == MESSAGE_ABORT) {
        disarm(b, REASON_ABORT);
    } else if (frame->type == MESSAGE_HELLO) {
        on_hello(b, frame);
    } else if (class == FRAME_NOT_ACCEPTED || frame->session != b->link.session || b->link.session == 0) {
        b->link.seq_errors++;
    } else if (class == FRAME_SEQUENCED) {
        handle_sequenced(b, frame);
    } else {
        handle_unsequenced(b, frame);
    }
}

static void send_ack(struct board *b) {
    uint8_t body[ACK_SIZE];
    body[ACK_NEXT_SEQ_AT] = b->link.expected;
    put_u16(body + ACK_FREE_POINTS_AT, (uint16_t)(b->config.queue_points - b->queue.count));
    put_u32(body + ACK_DONE_INDEX_AT, b->done_index);
    body[ACK_STATE_AT] = b->state;
    send_message(b, MESSAGE_ACK, body, sizeof body);
}

static uint32_t count_bad_frames(const struct board *b) {
    return b->link.receiver.crc_errors + b->link.receiver.format_errors;
}

void board_receive(struct board *b, const uint8_t *bytes, size_t n, uint64_t now_us) {
    struct frame frame;
    uint32_t bad = count_bad_frames(b);
    b->loop_ran = true;
    advance_held(b, now_us);
    send_reports(b);
    for (size_t k = 0; k < n; k++) {
        if (receiver_feed(&b->link.receiver, bytes[k], &frame)) {
            hold_tick(b, true);
            handle_frame(b, &frame);
            hold_tick(b, false);
        }
    }
    if (count_bad_frames(b) != bad && b->hal.trace) {
        struct board_trace event = {.at_us = b->now_us, .kind = TRACE_RX_ERROR, .index = count_bad_frames(b)};
        b->hal.trace(b->hal.context, &event);
    }
    if (b->link.ack_due) {
        b->link.ack_due = false;
        hold_tick(b, true);
        send_ack(b);
        hold_tick(b, false);
    }
    advance_held(b, now_us);
    send_reports(b);
}

void board_on_link_lost(struct board *b, uint64_t now_us) {
    advance_held(b, now_us);
    send_reports(b);
    hold_tick(b, true);
    disarm(b, REASON_LINK_LOST);
    hold_tick(b, false);
}

/* --- power-up --- */

/* A port that states more than its tables hold would have the guards write beyond them. */
static uint16_t bound_by(uint16_t stated, uint32_t held) {
    return stated < held ? stated : (uint16_t)held;
}

void board_init(struct board *b, const struct board_hal *hal, const struct board_config *config,
                enum reset_cause cause, uint64_t now_us) {
    hal->set_gate(hal->context, false, 0); /* before anything else */
    memset(b, 0, sizeof *b);
    b->hal = *hal;
    b->config = *config;
    b->config.queue_points = bound_by(config->queue_points, BOARD_QUEUE_POINTS);
    b->config.cells = bound_by(config->cells, BOARD_CELLS);
    b->config.window_pulses = bound_by(config->window_pulses, BOARD_PULSES);
    b->limits = config->limits;
    b->now_us = b->epoch_us = b->settled_us = b->last_tick_us = now_us;
    b->reset_cause = (uint8_t)cause;
    b->x = b->y = CENTRE;
    b->follows = config->feedback_codes == 0;
    b->settled_us += b->follows ? 0 : settling_us(&b->limits, CENTRE);
    hal->move_mirrors(hal->context, b->x, b->y); /* their position after a reset is unknown */
    b->inputs = hal->read_inputs(hal->context) & (INPUT_INTERLOCK | INPUT_KEY | INPUT_ESTOP);
    b->triggers_read = b->triggers_before = hal->read_triggers(hal->context, &b->trigger_us);
    link_begin(&b->link, 0);
    change_state(b, REASON_BOOT);
}
