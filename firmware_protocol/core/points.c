/* Execution of points: move, gate-off time, pulse; end of job, underrun and hold. */

#include "core.h"

bool has_enough_points(const struct board *b) {
    bool all_here = b->job.has_end && b->next_index >= b->job.end_index;
    return b->job.active && b->queue.count > 0 && (all_here || b->queue.count >= b->job.watermark);
}

uint32_t settling_us(const struct board_limits *limits, uint32_t codes) {
    return limits->settle_us + (uint32_t)(((uint64_t)codes * limits->settle_ns_per_code + 999) / 1000);
}

/* B7: an interrupted move may have left the mirrors anywhere on its path, so its own settling time counts too. */
static uint64_t settling_end_us(const struct board *b, const struct point *point) {
    uint32_t along_x = point->x > b->x ? point->x - b->x : b->x - point->x;
    uint32_t along_y = point->y > b->y ? point->y - b->y : b->y - point->y;
    uint32_t move = along_x > along_y ? along_x : along_y;
    if (move == 0) {
        return b->settled_us;
    }
    uint64_t from_us = b->settled_us > b->now_us ? b->settled_us : b->now_us;
    return from_us + settling_us(&b->limits, move);
}

static void begin_point(struct board *b) {
    b->current_index = b->next_index - b->queue.count;
    b->current_point = queue_pop(&b->queue);
    b->has_current_point = true;
    b->settled_us = settling_end_us(b, &b->current_point);
    b->x = b->current_point.x;
    b->y = b->current_point.y;
    b->hal.move_mirrors(b->hal.context, b->x, b->y);
    b->due_us = b->now_us + b->current_point.dark_us;
#if MUTANT != 7
    if (b->due_us < b->settled_us) {
        b->due_us = b->settled_us;
    }
#endif
}

static void begin_pulse(struct board *b) {
    enum fault fault = MUTANT == 105 ? FAULT_NONE : find_unsafe(b);
    if (fault == FAULT_NONE) {
        fault = guards_accept_pulse(&b->guards, &b->limits, &b->config, &b->current_point, b->now_us);
    }
    if (fault != FAULT_NONE) {
        enter_fault(b, fault);
        return;
    }
    b->gate_on_us = b->now_us;
    b->due_us = b->now_us + b->current_point.on_us;
    command_gate(b, true, b->current_point.duty);
    trace_gate(b, true, true, b->current_index);
}

/* UNDERRUNS_MAX within the window are a fault, so the list never holds more. */
static void on_underrun(struct board *b) {
    b->underruns_total++;
    uint32_t kept = 0;
    for (uint32_t k = 0; k < b->underruns_count; k++) {
        if (b->underruns_us[k] + UNDERRUN_WINDOW_US >= b->now_us) {
            b->underruns_us[kept++] = b->underruns_us[k];
        }
    }
    b->underruns_us[kept++] = b->now_us;
    b->underruns_count = kept;
    if (kept >= UNDERRUNS_MAX) {
        enter_fault(b, FAULT_UNDERRUN);
        return;
    }
    b->hold_since_us = b->now_us;
    change_state(b, REASON_QUEUE_EMPTY);
}

static void finish_point(struct board *b) {
    bool gate_was_on = b->gate;
#if MUTANT == 2
    if (gate_was_on && b->queue.count == 0 && !(b->job.has_end && b->current_index + 1 >= b->job.end_index)) {
        b->due_us += 1000;
        return;
    }
#endif
    if (gate_was_on) {
        command_gate(b, false, 0);
        trace_gate(b, false, true, b->current_index);
    }
    record_execution(b, gate_was_on ? b->gate_on_us : b->now_us, gate_was_on ? b->current_point.on_us : 0);
    b->has_current_point = false;
    if (b->job.active && b->job.has_end && b->done_index >= b->job.end_index) {
        b->job.active = false;
        change_state(b, REASON_JOB_DONE);
    } else if (b->queue.count > 0) {
        begin_point(b);
    } else {
        on_underrun(b);
    }
}

void advance_point(struct board *b) {
    if (!b->has_current_point) {
        begin_point(b);
    } else if (!b->gate && b->current_point.on_us > 0) {
        begin_pulse(b);
    } else {
        finish_point(b);
    }
}

void resume_if_refilled(struct board *b) {
    if (b->state == STATE_HOLD && has_enough_points(b)) {
        change_state(b, REASON_REFILLED);
    }
}
