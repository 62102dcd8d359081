/* Generated from messages.toml by generate.py: do not edit. PROTOCOL.md says what the messages mean. */

#ifndef MESSAGES_H
#define MESSAGES_H

#define PROTOCOL_MAJOR 1u
#define PROTOCOL_MINOR 0u
#define RAW_MAX 252u
#define RX_WINDOW 8u
#define SEQ_MODULUS 256u
#define TICK_HZ 1000000u
#define INDICATOR_US 2000000u
#define ARMING_TIMEOUT_US 10000000u
#define HOLD_MAX_US 1000000u
#define UNDERRUNS_MAX 3u
#define UNDERRUN_WINDOW_US 10000000u
#define MEAN_WINDOW_US 1000000u
#define EXECUTED_RING 8192u
#define DATA_ITEMS_MAX 24u
#define EXECUTED_ITEMS_MAX 28u

enum state {
    STATE_BOOT = 0,
    STATE_DISARMED = 1,
    STATE_ARMING = 2,
    STATE_ARMED = 3,
    STATE_RUNNING = 4,
    STATE_HOLD = 5,
    STATE_FAULT = 6,
};
#define STATE_COUNT 7u
#define STATE_NAMES {"BOOT", "DISARMED", "ARMING", "ARMED", "RUNNING", "HOLD", "FAULT"}

enum fault {
    FAULT_NONE = 0,
    FAULT_LINK = 1,
    FAULT_RANGE = 2,
    FAULT_ON_TIME = 3,
    FAULT_DUTY = 4,
    FAULT_MEAN_POWER = 5,
    FAULT_SPOT = 6,
    FAULT_UNDERRUN = 7,
    FAULT_INTERLOCK = 8,
    FAULT_KEY = 9,
    FAULT_ESTOP = 10,
    FAULT_TICK = 11,
    FAULT_READBACK = 12,
};
#define FAULT_COUNT 13u
#define FAULT_NAMES {"", "LINK", "RANGE", "ON_TIME", "DUTY", "MEAN_POWER", "SPOT", "UNDERRUN", "INTERLOCK", "KEY", "ESTOP", "TICK", "READBACK"}

enum nak {
    NAK_SEQUENCE = 0,
    NAK_NO_ROOM = 1,
    NAK_STATE = 2,
    NAK_INDEX = 3,
    NAK_NONCE = 4,
    NAK_KEY_EDGE = 5,
    NAK_INPUT = 6,
    NAK_VERSION = 7,
};
#define NAK_COUNT 8u
#define NAK_NAMES {"SEQUENCE", "NO_ROOM", "STATE", "INDEX", "NONCE", "KEY_EDGE", "INPUT", "VERSION"}

enum reason {
    REASON_NONE = 0,
    REASON_BOOT = 1,
    REASON_HELLO = 2,
    REASON_ARM_REQUESTED = 3,
    REASON_ARMED = 4,
    REASON_START = 5,
    REASON_JOB_DONE = 6,
    REASON_QUEUE_EMPTY = 7,
    REASON_REFILLED = 8,
    REASON_HOLD_TOO_LONG = 9,
    REASON_DISARM = 10,
    REASON_ABORT = 11,
    REASON_LINK_LOST = 12,
    REASON_ARMING_TIMED_OUT = 13,
    REASON_FAULT = 14,
    REASON_FAULT_CLEARED = 15,
    REASON_FLUSH = 16,
};
#define REASON_COUNT 17u
#define REASON_NAMES {"", "boot", "hello", "arm requested", "armed", "start", "job done", "queue empty", "refilled", "hold too long", "disarm", "abort", "link lost", "arming timed out", "fault", "fault cleared", "flush"}

#define INPUT_INTERLOCK 1u
#define INPUT_KEY 2u
#define INPUT_ESTOP 4u
#define INPUT_COUNT 3u
#define INPUT_NAMES {"interlock", "key", "estop"}

#define MESSAGE_HELLO 0x01
#define MESSAGE_LIMITS 0x02
#define MESSAGE_CLOCK 0x03
#define MESSAGE_LEASE 0x04
#define MESSAGE_DATA 0x10
#define MESSAGE_START 0x11
#define MESSAGE_END 0x12
#define MESSAGE_ABORT 0x13
#define MESSAGE_ARM_REQ 0x14
#define MESSAGE_ARM_CONFIRM 0x15
#define MESSAGE_DISARM 0x16
#define MESSAGE_CLEAR_FAULT 0x17
#define MESSAGE_GET 0x18
#define MESSAGE_FLUSH 0x19
#define MESSAGE_GET_EXECUTED 0x1a
#define MESSAGE_HELLO_REPLY 0x81
#define MESSAGE_CLOCK_REPLY 0x83
#define MESSAGE_ARM_CHALLENGE 0x94
#define MESSAGE_ACK 0x90
#define MESSAGE_NAK 0x91
#define MESSAGE_EVENT 0x92
#define MESSAGE_STATUS 0x98
#define MESSAGE_EXECUTED 0x99

#define HELLO_MAJOR_AT 0u
#define HELLO_MINOR_AT 1u
#define HELLO_HOST_NONCE_AT 2u
#define HELLO_SIZE 6u

#define LIMITS_LIMITS_AT 0u
#define LIMITS_SIZE 34u

#define CLOCK_HOST_T_AT 0u
#define CLOCK_SIZE 4u

#define LEASE_MS_AT 0u
#define LEASE_SIZE 2u

#define DATA_FIRST_INDEX_AT 0u
#define DATA_POINTS_AT 4u
#define DATA_SIZE 4u

#define START_JOB_AT 0u
#define START_FIRST_INDEX_AT 4u
#define START_START_TICK_AT 8u
#define START_WATERMARK_AT 16u
#define START_SIZE 18u

#define END_JOB_AT 0u
#define END_END_INDEX_AT 4u
#define END_SIZE 8u

#define ABORT_SIZE 0u

#define ARM_REQ_HOST_NONCE_AT 0u
#define ARM_REQ_SIZE 4u

#define ARM_CONFIRM_HOST_NONCE_AT 0u
#define ARM_CONFIRM_BOARD_NONCE_AT 4u
#define ARM_CONFIRM_SIZE 8u

#define DISARM_SIZE 0u

#define CLEAR_FAULT_SIZE 0u

#define GET_SIZE 0u

#define FLUSH_SIZE 0u

#define GET_EXECUTED_FIRST_INDEX_AT 0u
#define GET_EXECUTED_SIZE 4u

#define HELLO_REPLY_MAJOR_AT 0u
#define HELLO_REPLY_MINOR_AT 1u
#define HELLO_REPLY_HOST_NONCE_AT 2u
#define HELLO_REPLY_SESSION_AT 6u
#define HELLO_REPLY_FIRMWARE_AT 8u
#define HELLO_REPLY_UID_AT 12u
#define HELLO_REPLY_CAPABILITIES_AT 24u
#define HELLO_REPLY_TICK_HZ_AT 28u
#define HELLO_REPLY_QUEUE_POINTS_AT 32u
#define HELLO_REPLY_RX_WINDOW_AT 34u
#define HELLO_REPLY_CELL_CODES_AT 36u
#define HELLO_REPLY_RESET_CAUSE_AT 38u
#define HELLO_REPLY_LIMITS_AT 39u
#define HELLO_REPLY_SIZE 73u

#define CLOCK_REPLY_HOST_T_AT 0u
#define CLOCK_REPLY_TICK_AT 4u
#define CLOCK_REPLY_SIZE 12u

#define ARM_CHALLENGE_HOST_NONCE_AT 0u
#define ARM_CHALLENGE_BOARD_NONCE_AT 4u
#define ARM_CHALLENGE_SIZE 8u

#define ACK_NEXT_SEQ_AT 0u
#define ACK_FREE_POINTS_AT 1u
#define ACK_DONE_INDEX_AT 3u
#define ACK_STATE_AT 7u
#define ACK_SIZE 8u

#define NAK_NEXT_SEQ_AT 0u
#define NAK_REASON_AT 1u
#define NAK_SIZE 2u

#define EVENT_STATE_AT 0u
#define EVENT_FAULT_AT 1u
#define EVENT_REASON_AT 2u
#define EVENT_TICK_AT 3u
#define EVENT_SIZE 11u

#define STATUS_STATE_AT 0u
#define STATUS_FAULT_AT 1u
#define STATUS_INPUTS_AT 2u
#define STATUS_TICK_AT 3u
#define STATUS_DONE_INDEX_AT 11u
#define STATUS_QUEUED_AT 15u
#define STATUS_CRC_ERRORS_AT 17u
#define STATUS_FORMAT_ERRORS_AT 19u
#define STATUS_SEQ_ERRORS_AT 21u
#define STATUS_UNDERRUNS_AT 23u
#define STATUS_LASER_ON_US_AT 25u
#define STATUS_TEMPERATURE_DC_AT 33u
#define STATUS_SIZE 35u

#define EXECUTED_FIRST_INDEX_AT 0u
#define EXECUTED_BASE_TICK_AT 4u
#define EXECUTED_RECORDS_AT 12u
#define EXECUTED_SIZE 12u

#define POINT_X_AT 0u
#define POINT_Y_AT 2u
#define POINT_DARK_US_AT 4u
#define POINT_ON_US_AT 6u
#define POINT_DUTY_AT 8u
#define POINT_SIZE 10u

#define RECORD_OFFSET_AT 0u
#define RECORD_ON_TICKS_AT 4u
#define RECORD_DUTY_AT 6u
#define RECORD_SIZE 8u

#define LIMITS_MAX_ON_US_AT 0u
#define LIMITS_MAX_DUTY_AT 2u
#define LIMITS_MEAN_DUTY_AT 4u
#define LIMITS_SPOT_UJ_AT 6u
#define LIMITS_SPOT_LEAK_UW_AT 10u
#define LIMITS_FULL_POWER_UW_AT 14u
#define LIMITS_X_MIN_AT 18u
#define LIMITS_X_MAX_AT 20u
#define LIMITS_Y_MIN_AT 22u
#define LIMITS_Y_MAX_AT 24u
#define LIMITS_SETTLE_US_AT 26u
#define LIMITS_SETTLE_NS_PER_CODE_AT 28u
#define LIMITS_REST_US_AT 30u
#define LIMITS_LEASE_MS_AT 32u
#define LIMITS_SIZE 34u

#define LIMITS_FIELDS(F) \
    F(max_on_us, 16, 0, LESS) \
    F(max_duty, 16, 2, LESS) \
    F(mean_duty, 16, 4, LESS) \
    F(spot_uj, 32, 6, LESS) \
    F(spot_leak_uw, 32, 10, LESS) \
    F(full_power_uw, 32, 14, FIXED) \
    F(x_min, 16, 18, MORE) \
    F(x_max, 16, 20, LESS) \
    F(y_min, 16, 22, MORE) \
    F(y_max, 16, 24, LESS) \
    F(settle_us, 16, 26, MORE) \
    F(settle_ns_per_code, 16, 28, MORE) \
    F(rest_us, 16, 30, MORE) \
    F(lease_ms, 16, 32, LESS)

/* F(type, from_host, sequenced, body bytes, bytes an item, most items, offset and count of up to three
   enumerations in the body; count 0: none) */
#define MESSAGE_FORMS(F) \
    F(MESSAGE_HELLO, 1, 0, HELLO_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_LIMITS, 1, 1, LIMITS_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_CLOCK, 1, 0, CLOCK_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_LEASE, 1, 0, LEASE_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_DATA, 1, 1, DATA_SIZE, 10, 24, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_START, 1, 1, START_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_END, 1, 1, END_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_ABORT, 1, 0, ABORT_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_ARM_REQ, 1, 1, ARM_REQ_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_ARM_CONFIRM, 1, 1, ARM_CONFIRM_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_DISARM, 1, 1, DISARM_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_CLEAR_FAULT, 1, 1, CLEAR_FAULT_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_GET, 1, 0, GET_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_FLUSH, 1, 1, FLUSH_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_GET_EXECUTED, 1, 0, GET_EXECUTED_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_HELLO_REPLY, 0, 0, HELLO_REPLY_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_CLOCK_REPLY, 0, 0, CLOCK_REPLY_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_ARM_CHALLENGE, 0, 0, ARM_CHALLENGE_SIZE, 0, 0, 0, 0, 0, 0, 0, 0) \
    F(MESSAGE_ACK, 0, 0, ACK_SIZE, 0, 0, 7, STATE_COUNT, 0, 0, 0, 0) \
    F(MESSAGE_NAK, 0, 0, NAK_SIZE, 0, 0, 1, NAK_COUNT, 0, 0, 0, 0) \
    F(MESSAGE_EVENT, 0, 0, EVENT_SIZE, 0, 0, 0, STATE_COUNT, 1, FAULT_COUNT, 2, REASON_COUNT) \
    F(MESSAGE_STATUS, 0, 0, STATUS_SIZE, 0, 0, 0, STATE_COUNT, 1, FAULT_COUNT, 0, 0) \
    F(MESSAGE_EXECUTED, 0, 0, EXECUTED_SIZE, 8, 28, 0, 0, 0, 0, 0, 0)

#endif
