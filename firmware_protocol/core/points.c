/* Points one after the other: move, dark time, light; the ends of jobs, underruns and holds. */

#include "core.h"

bool enough_queued(const struct board *b) {
    bool all_here = b->job.ends && b->next_index >= b->job.end_index;
    return b->job.exists && b->queue.count > 0 && (all_here || b->queue.count >= b->job.watermark);
}

/* B7. A move that was broken off may have left the mirrors anywhere on its way: its own time counts too. */
static uint64_t settled_us(const struct board *b, const struct point *point) {
    uint32_t along_x = point->x > b->x ? point->x - b->x : b->x - point->x;
    uint32_t along_y = point->y > b->y ? point->y - b->y : b->y - point->y;
    uint64_t move = along_x > along_y ? along_x : along_y;
    if (move == 0) {
        return b->settled_us;
    }
    uint64_t from_us = b->settled_us > b->now_us ? b->settled_us : b->now_us;
    return from_us + b->limits.settle_us + (move * b->limits.settle_ns_per_code + 999) / 1000;
}

static void begin_point(struct board *b) {
    b->current_number = b->next_index - b->queue.count;
    b->current = queue_pop(&b->queue);
    b->has_current = true;
    b->settled_us = settled_us(b, &b->current);
    b->x = b->current.x;
    b->y = b->current.y;
    b->hal.mirrors(b->hal.context, b->x, b->y);
    b->due_us = b->now_us + b->current.dark_us;
#if MUTANT != 7
    if (b->due_us < b->settled_us) {
        b->due_us = b->settled_us;
    }
#endif
}

static void light(struct board *b) {
    enum fault fault = guards_fire(&b->guards, &b->limits, b->config.cell_codes, &b->current, b->now_us);
    if (fault != FAULT_NONE) {
        fail(b, fault);
        return;
    }
    b->lit_us = b->now_us;
    b->due_us = b->now_us + b->current.on_us;
    set_gate(b, true, b->current.duty);
    trace_gate(b, true, true, b->current_number);
}

/* Three within the window are a fault; the list never holds more. */
static void underrun(struct board *b) {
    b->underruns_total++;
    uint32_t kept = 0;
    for (uint32_t k = 0; k < b->underruns_known; k++) {
        if (b->underruns_us[k] + UNDERRUN_WINDOW_US >= b->now_us) {
            b->underruns_us[kept++] = b->underruns_us[k];
        }
    }
    b->underruns_us[kept++] = b->now_us;
    b->underruns_known = kept;
    if (kept >= UNDERRUNS_MAX) {
        fail(b, FAULT_UNDERRUN);
        return;
    }
    b->hold_since_us = b->now_us;
    change_state(b, REASON_QUEUE_EMPTY);
}

static void finish_point(struct board *b) {
    bool lit = b->gate;
#if MUTANT == 2
    if (lit && b->queue.count == 0 && !(b->job.ends && b->current_number + 1 >= b->job.end_index)) {
        b->due_us += 1000;
        return;
    }
#endif
    if (lit) {
        set_gate(b, false, 0);
        trace_gate(b, false, true, b->current_number);
    }
    record_point(b, lit ? b->lit_us : b->now_us, lit ? b->current.on_us : 0);
    b->has_current = false;
    if (b->job.exists && b->job.ends && b->done_index >= b->job.end_index) {
        b->job.exists = false;
        change_state(b, REASON_JOB_DONE);
    } else if (b->queue.count > 0) {
        begin_point(b);
    } else {
        underrun(b);
    }
}

void point_due(struct board *b) {
    if (!b->has_current) {
        begin_point(b);
    } else if (!b->gate && b->current.on_us > 0) {
        light(b);
    } else {
        finish_point(b);
    }
}

void refill(struct board *b) {
    if (b->state == STATE_HOLD && enough_queued(b)) {
        change_state(b, REASON_REFILLED);
    }
}
