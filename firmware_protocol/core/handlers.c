/* Message handlers. Each checks its refusals in the order of PROTOCOL.md. */

#include <string.h>

#include "core.h"

#define ENTROPY_TRIES 16u
#define INDEX_MAX UINT32_MAX
#define CAPABILITY_KEY_EDGE 1u
#define CAPABILITY_XY2_100 2u
#define CAPABILITY_EXACT_WIDTHS 4u
#define CAPABILITY_FEEDBACK 8u
#define MS 1000u

static bool inputs_safe(const struct board *b) { return find_unsafe_inputs(b->inputs) == 0 && is_head_ready(b) && b->follows; }

static bool is_armed(const struct board *b) {
    return STATES_ARMED >> b->state & 1u;
}

/* --- unsequenced messages --- */

/* Neither 0 nor the last session. The number of tries is bounded in case the entropy source repeats itself. */
static uint16_t choose_session(struct board *b) {
    for (uint32_t k = 0; k < ENTROPY_TRIES; k++) {
        uint16_t session = (uint16_t)b->hal.read_entropy(b->hal.context);
        if (session != 0 && session != b->link.session) {
            return session;
        }
    }
    return b->link.session == UINT16_MAX ? 1 : (uint16_t)(b->link.session + 1);
}

void on_hello(struct board *b, const struct frame *frame) {
    uint8_t body[HELLO_REPLY_SIZE];
    disarm(b, REASON_HELLO);
    link_begin(&b->link, choose_session(b));
    b->limits = b->config.limits;
    b->next_index = b->done_index = 0;
    records_clear(&b->records);
    b->hal.discard_output(b->hal.context);
    b->version_supported = frame->body[HELLO_MAJOR_AT] == PROTOCOL_MAJOR;
    body[HELLO_REPLY_MAJOR_AT] = PROTOCOL_MAJOR;
    body[HELLO_REPLY_MINOR_AT] = PROTOCOL_MINOR;
    memcpy(body + HELLO_REPLY_HOST_NONCE_AT, frame->body + HELLO_HOST_NONCE_AT, 4);
    put_u16(body + HELLO_REPLY_SESSION_AT, b->link.session);
    put_u32(body + HELLO_REPLY_FIRMWARE_AT, b->config.firmware);
    memcpy(body + HELLO_REPLY_UID_AT, b->config.uid, sizeof b->config.uid);
    put_u32(body + HELLO_REPLY_CAPABILITIES_AT, (b->config.key_edge ? CAPABILITY_KEY_EDGE : 0) |
                                                    (b->config.interface == INTERFACE_XY2_100 ? CAPABILITY_XY2_100 : 0) |
                                                    (b->hal.has_exact_widths ? CAPABILITY_EXACT_WIDTHS : 0) |
                                                    (b->config.feedback_codes > 0 ? CAPABILITY_FEEDBACK : 0));
    put_u32(body + HELLO_REPLY_TICK_HZ_AT, TICK_HZ);
    put_u16(body + HELLO_REPLY_QUEUE_POINTS_AT, b->config.queue_points);
    put_u16(body + HELLO_REPLY_RX_WINDOW_AT, RX_WINDOW);
    put_u16(body + HELLO_REPLY_CELL_CODES_AT, b->config.cell_codes);
    put_u16(body + HELLO_REPLY_CELLS_AT, b->config.cells);
    put_u16(body + HELLO_REPLY_WINDOW_PULSES_AT, b->config.window_pulses);
    body[HELLO_REPLY_RESET_CAUSE_AT] = b->reset_cause;
    limits_encode(&b->limits, body + HELLO_REPLY_LIMITS_AT);
    send_message(b, MESSAGE_HELLO_REPLY, body, sizeof body);
}

static void renew_lease(struct board *b, uint16_t requested_ms) {
    uint16_t ms = requested_ms < b->limits.lease_ms ? requested_ms : b->limits.lease_ms;
    uint64_t until_us = b->now_us + (uint64_t)ms * MS;
    if (is_leased(b->state) && until_us > b->lease_until_us) {
        b->lease_until_us = until_us;
    }
}

static void send_clock_reply(struct board *b, const uint8_t *requested) {
    uint8_t body[CLOCK_REPLY_SIZE];
    memcpy(body + CLOCK_REPLY_HOST_T_AT, requested + CLOCK_HOST_T_AT, 4);
    put_u64(body + CLOCK_REPLY_TICK_AT, b->now_us - b->epoch_us);
    send_message(b, MESSAGE_CLOCK_REPLY, body, sizeof body);
}

static uint16_t clip_code(int32_t code) { return (uint16_t)(code < 0 ? 0 : code > UINT16_MAX ? UINT16_MAX : code); }

static void send_status(struct board *b) {
    uint8_t body[STATUS_SIZE];
    body[STATUS_STATE_AT] = b->state;
    body[STATUS_FAULT_AT] = b->fault;
    body[STATUS_INPUTS_AT] = b->inputs;
    put_u64(body + STATUS_TICK_AT, b->now_us - b->epoch_us);
    put_u32(body + STATUS_DONE_INDEX_AT, b->done_index);
    put_u16(body + STATUS_QUEUED_AT, (uint16_t)b->queue.count);
    put_u16(body + STATUS_CRC_ERRORS_AT, (uint16_t)b->link.receiver.crc_errors);
    put_u16(body + STATUS_FORMAT_ERRORS_AT, (uint16_t)b->link.receiver.format_errors);
    put_u16(body + STATUS_SEQ_ERRORS_AT, (uint16_t)b->link.seq_errors);
    put_u16(body + STATUS_UNDERRUNS_AT, (uint16_t)b->underruns_total);
    put_u64(body + STATUS_LASER_ON_US_AT, b->laser_on_duty_us / 65535u);
    put_u16(body + STATUS_TEMPERATURE_DC_AT, (uint16_t)b->hal.read_temperature_dc(b->hal.context));
    put_u16(body + STATUS_HEAD_AT, b->head);
    put_u16(body + STATUS_MIRROR_X_AT, clip_code(b->measured_x));
    put_u16(body + STATUS_MIRROR_Y_AT, clip_code(b->measured_y));
    send_message(b, MESSAGE_STATUS, body, sizeof body);
}

static void send_executed(struct board *b, uint32_t first_index) {
    uint8_t body[BODY_MAX];
    size_t length;
    if (records_report(&b->records, records_find(&b->records, first_index), body, &length) > 0) {
        send_message(b, MESSAGE_EXECUTED, body, length);
    }
}

static void send_triggers(struct board *b) {
    uint32_t count = b->triggers_read - b->triggers_before;
    uint8_t body[TRIGGERS_SIZE];
    put_u32(body + TRIGGERS_COUNT_AT, count);
    put_u64(body + TRIGGERS_TICK_AT, count > 0 ? b->trigger_us - b->epoch_us : 0);
    send_message(b, MESSAGE_TRIGGERS, body, sizeof body);
}

void handle_unsequenced(struct board *b, const struct frame *frame) {
    switch (frame->type) {
    case MESSAGE_LEASE:
        renew_lease(b, get_u16(frame->body + LEASE_MS_AT));
        break;
    case MESSAGE_CLOCK:
        send_clock_reply(b, frame->body);
        break;
    case MESSAGE_GET:
        send_status(b);
        break;
    case MESSAGE_GET_EXECUTED:
        send_executed(b, get_u32(frame->body + GET_EXECUTED_FIRST_INDEX_AT));
        break;
    case MESSAGE_GET_TRIGGERS:
        send_triggers(b);
        break;
    default:
        break;
    }
}

/* --- sequenced messages --- */

static uint8_t on_limits(struct board *b, const uint8_t *body) {
    struct board_limits requested;
    if (!(STATES_IDLE >> b->state & 1u)) {
        return NAK_STATE;
    }
    limits_decode(&requested, body + LIMITS_LIMITS_AT);
    limits_tighten(&b->limits, &requested);
    return NO_REFUSAL;
}

static struct point point_get(const uint8_t *at) {
    return (struct point){
        .x = get_u16(at + POINT_X_AT),
        .y = get_u16(at + POINT_Y_AT),
        .dark_us = get_u16(at + POINT_DARK_US_AT),
        .on_us = get_u16(at + POINT_ON_US_AT),
        .duty = get_u16(at + POINT_DUTY_AT),
    };
}

static uint8_t on_data(struct board *b, const uint8_t *body, size_t length) {
    uint32_t first = get_u32(body + DATA_FIRST_INDEX_AT), count = (uint32_t)((length - DATA_SIZE) / POINT_SIZE);
    bool idle = !b->job.active && b->queue.count == 0;
    if (!is_armed(b)) {
        return NAK_STATE;
    }
#if MUTANT != 12 && MUTANT != 103
    if (first < b->next_index || (first > b->next_index && !idle)) {
        return NAK_INDEX;
    }
#endif
    if (count > INDEX_MAX - first) {
        return NAK_INDEX;
    }
    if (b->queue.count + count > b->config.queue_points) {
        return NAK_NO_ROOM;
    }
    for (uint32_t k = 0; k < count; k++) {
        struct point point = point_get(body + DATA_SIZE + k * POINT_SIZE);
        enum fault fault = guards_check_point(&b->limits, &point);
        if (fault != FAULT_NONE) {
            enter_fault(b, fault);
            return NAK_STATE;
        }
    }
    if (idle) {
        b->done_index = first;
    }
    for (uint32_t k = 0; k < count; k++) {
        struct point point = point_get(body + DATA_SIZE + k * POINT_SIZE);
        queue_push(&b->queue, &point);
    }
    b->next_index = first + count;
    resume_if_refilled(b);
    return NO_REFUSAL;
}

static uint8_t on_start(struct board *b, const uint8_t *body) {
    uint64_t tick = get_u64(body + START_START_TICK_AT);
    if (b->state != STATE_ARMED) {
        return NAK_STATE;
    }
    if (get_u32(body + START_FIRST_INDEX_AT) != b->next_index - b->queue.count) {
        return NAK_INDEX;
    }
    b->job = (struct job){.active = true, .number = get_u32(body + START_JOB_AT), .start_us = b->now_us};
    b->job.watermark = get_u16(body + START_WATERMARK_AT);
    if (tick > b->now_us - b->epoch_us) {
        /* A start beyond the clock's range never comes; the limit keeps start + HOLD_MAX_US from wrapping. */
        uint64_t last = UINT64_MAX - HOLD_MAX_US - 1 - b->epoch_us;
        b->job.start_us = b->epoch_us + (tick < last ? tick : last);
    }
    change_state(b, REASON_START);
    return NO_REFUSAL;
}

static uint8_t on_start_on_trigger(struct board *b, const uint8_t *body) {
    if (b->state != STATE_ARMED) {
        return NAK_STATE;
    }
    if (get_u32(body + START_ON_TRIGGER_FIRST_INDEX_AT) != b->next_index - b->queue.count || b->queue.count == 0) {
        return NAK_INDEX;
    }
    b->job = (struct job){
        .active = true,
        .awaits_trigger = true,
        .number = get_u32(body + START_ON_TRIGGER_JOB_AT),
        .delay_us = get_u32(body + START_ON_TRIGGER_DELAY_US_AT),
        .accepted_us = b->now_us,
        .start_us = b->now_us + (uint64_t)get_u16(body + START_ON_TRIGGER_WAIT_MS_AT) * MS,
    };
    change_state(b, REASON_START);
    return NO_REFUSAL;
}

static uint8_t on_end(struct board *b, const uint8_t *body) {
    uint32_t end_index = get_u32(body + END_END_INDEX_AT);
    if (!b->job.active || b->job.number != get_u32(body + END_JOB_AT)) {
        return NAK_STATE;
    }
    if (end_index != b->next_index) {
        return NAK_INDEX;
    }
    b->job.end_index = end_index;
    b->job.has_end = true;
    if (b->done_index >= end_index) {
        b->job.active = false;
        change_state(b, REASON_JOB_DONE);
    }
    resume_if_refilled(b);
    return NO_REFUSAL;
}

static uint8_t on_arm_req(struct board *b, const uint8_t *requested) {
    uint8_t body[ARM_CHALLENGE_SIZE];
    if (b->state != STATE_DISARMED) {
        return NAK_STATE;
    }
    if (!b->version_supported) {
        return NAK_VERSION;
    }
    if (!inputs_safe(b)) {
        return NAK_INPUT;
    }
    if (b->config.key_edge && !b->key_turned) {
        return NAK_KEY_EDGE;
    }
    b->board_nonce = b->hal.read_entropy(b->hal.context);
    b->nonce_valid = true;
    b->host_nonce = get_u32(requested + ARM_REQ_HOST_NONCE_AT);
    b->arming_since_us = b->now_us;
    b->confirmed = false;
    b->lease_until_us = b->now_us + (uint64_t)b->limits.lease_ms * MS;
    change_state(b, REASON_ARM_REQUESTED);
    put_u32(body + ARM_CHALLENGE_HOST_NONCE_AT, b->host_nonce);
    put_u32(body + ARM_CHALLENGE_BOARD_NONCE_AT, b->board_nonce);
    send_message(b, MESSAGE_ARM_CHALLENGE, body, sizeof body);
    return NO_REFUSAL;
}

/* B11: a nonce is valid for one confirmation, right or wrong. */
static uint8_t on_arm_confirm(struct board *b, const uint8_t *body) {
    bool echoed = b->nonce_valid && get_u32(body + ARM_CONFIRM_BOARD_NONCE_AT) == b->board_nonce &&
                  get_u32(body + ARM_CONFIRM_HOST_NONCE_AT) == b->host_nonce;
#if MUTANT == 11
    echoed = true;
#endif
    b->nonce_valid = false;
    if (b->state != STATE_ARMING || b->confirmed) {
        return NAK_STATE;
    }
    if (!echoed) {
        disarm(b, REASON_DISARM);
        return NAK_NONCE;
    }
    b->confirmed = true;
    b->key_turned = false;
    return NO_REFUSAL;
}

static uint8_t on_clear_fault(struct board *b) {
    if (b->state != STATE_FAULT) {
        return NAK_STATE;
    }
    if (!inputs_safe(b)) {
        return NAK_INPUT;
    }
    b->fault = FAULT_NONE;
    b->underruns_count = 0;
    change_state(b, REASON_FAULT_CLEARED);
    return NO_REFUSAL;
}

static uint8_t on_flush(struct board *b) {
    if (!is_armed(b)) {
        return NAK_STATE;
    }
    if (b->state == STATE_ARMED) {
        drop_queue(b);
    } else {
        change_state(b, REASON_FLUSH);
    }
    return NO_REFUSAL;
}

uint8_t dispatch_sequenced(struct board *b, const struct frame *frame) {
    switch (frame->type) {
    case MESSAGE_LIMITS:
        return on_limits(b, frame->body);
    case MESSAGE_DATA:
        return on_data(b, frame->body, frame->length);
    case MESSAGE_START:
        return on_start(b, frame->body);
    case MESSAGE_START_ON_TRIGGER:
        return on_start_on_trigger(b, frame->body);
    case MESSAGE_END:
        return on_end(b, frame->body);
    case MESSAGE_ARM_REQ:
        return on_arm_req(b, frame->body);
    case MESSAGE_ARM_CONFIRM:
        return on_arm_confirm(b, frame->body);
    case MESSAGE_DISARM:
        disarm(b, REASON_DISARM);
        return NO_REFUSAL;
    case MESSAGE_CLEAR_FAULT:
        return on_clear_fault(b);
    default:
        return on_flush(b); /* the only sequenced message left */
    }
}
