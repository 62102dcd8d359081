/* Generated from messages.toml by generate.py: do not edit. */
#define IS_TRANSITION(from, to) ( \
    (from == DISARMED && to == ARMING) || \
    (from == ARMING && to == ARMED) || \
    (from == ARMING && to == DISARMED) || \
    (from == ARMED && to == RUNNING) || \
    (from == RUNNING && to == ARMED) || \
    (from == HOLD && to == ARMED) || \
    (from == RUNNING && to == HOLD) || \
    (from == RUNNING && to == DISARMED) || \
    (from == RUNNING && to == FAULT) || \
    (from == HOLD && to == RUNNING) || \
    (from == HOLD && to == DISARMED) || \
    (from == ARMED && to == DISARMED) || \
    (from == DISARMED && to == FAULT) || \
    (from == ARMING && to == FAULT) || \
    (from == ARMED && to == FAULT) || \
    (from == HOLD && to == FAULT) || \
    (from == FAULT && to == DISARMED))
