/* Scripts: steps of inputs and faults, at a time or at a signal. */

#include <string.h>

#include "host.h"

static const char *const INPUTS[INPUT_COUNT] = INPUT_NAMES;
static const char *const ACTIONS[] = {"",       "flip_bits", "drop_bytes", "hang",      "repair",
                                      "reset",  "close",     "stop_loop",  "stop_tick", "late_tick", "stick_gate",
                                      "trigger", "silence_head", "fail_head", "stick_mirror", "slow_mirror", "unplug_mirror"};
#define ACTION_NAMES \
    "one of flip_bits, drop_bytes, hang, repair, reset, close, trigger, stick_mirror, slow_mirror, " \
    "unplug_mirror; of this board alone: stop_loop, stop_tick, late_tick, stick_gate, " \
    " silence_head, fail_head"

const char *input_name(uint8_t bit) {
    for (size_t k = 0; k < INPUT_COUNT; k++) {
        if (bit == 1u << k) {
            return INPUTS[k];
        }
    }
    return "";
}

static double read_number(const struct toml_entry *entry, const char *where, const char *expected, double max) {
    bool is_number = entry && (entry->kind == TOML_INTEGER || entry->kind == TOML_FLOAT);
    if (!is_number || entry->number < 0 || entry->number > max) {
        bad_input(where, entry ? entry->raw : "nothing", expected);
    }
    return entry->number;
}

static void read_action(struct step *step, const struct toml *toml, unsigned table, const char *where) {
    const struct toml_entry *set = toml_find(toml, table, "set"), *act = toml_find(toml, table, "do");
    for (size_t k = 0; set && set->kind == TOML_STRING && k < INPUT_COUNT; k++) {
        if (strcmp(set->text, INPUTS[k]) == 0) {
            step->kind = STEP_SET;
            step->input = (uint8_t)(1u << k);
        }
    }
    for (size_t k = 1; !set && act && act->kind == TOML_STRING && k < sizeof ACTIONS / sizeof ACTIONS[0]; k++) {
        if (strcmp(act->text, ACTIONS[k]) == 0) {
            step->kind = (enum step_kind)k;
        }
    }
    if (set && !step->input) {
        bad_input(where, set->raw, "set to be one of interlock, key, estop");
    }
    if (!set && step->kind == STEP_SET) {
        bad_input(where, act ? act->raw : "neither set nor do", "do to be " ACTION_NAMES);
    }
}

static bool read_origin(const struct toml *toml, unsigned table, const char *where) {
    const struct toml_entry *from = toml_find(toml, table, "from");
    bool waits = from && from->kind == TOML_STRING && strcmp(from->text, "signal") == 0;
    if (from && !waits && !(from->kind == TOML_STRING && strcmp(from->text, "start") == 0)) {
        bad_input(where, from->raw, "from to be start or signal");
    }
    return waits;
}

static struct step read_step(const struct toml *toml, unsigned table, const char *path) {
    struct step step = {.rate = 0.01};
    char where[300];
    snprintf(where, sizeof where, "%s: step %u", path, table - 1);
    read_action(&step, toml, table, where);
    step.waits = read_origin(toml, table, where);
    const struct toml_entry *value = toml_find(toml, table, "value"), *rate = toml_find(toml, table, "rate");
    for (size_t k = 0; k < toml->count; k++) {
        const struct toml_entry *entry = &toml->entries[k];
        bool known = strcmp(entry->key, "from") == 0 || (!step.waits && strcmp(entry->key, "at_s") == 0) ||
                     strcmp(entry->key, step.kind == STEP_SET ? "set" : "do") == 0 ||
                     strcmp(entry->key, step.kind == STEP_SET ? "value" : "rate") == 0;
        if (entry->table == table && !known) {
            bad_input(where, entry->key, step.kind == STEP_SET ? "at_s, from, set, value" : "at_s, from, do, rate");
        }
    }
    if (!step.waits) {
        double at_s = read_number(toml_find(toml, table, "at_s"), where, "at_s, a time from 0 in s", 1e9);
        step.at_us = (uint64_t)(at_s * 1e6 + 0.5);
    }
    if (rate) {
        step.rate = read_number(rate, where, "a rate per byte, 0 to 1", 1.0);
    }
    if (value && value->kind != TOML_BOOLEAN) {
        bad_input(where, value->raw, "value to be true or false");
    }
    step.value = value && value->boolean;
    return step;
}

void script_read(struct script *script, const char *path) {
    static struct toml read;
    struct toml *toml = &read;
    toml_read(toml, path);
    for (size_t k = 0; k < toml->count; k++) {
        if (toml->entries[k].table == 0) {
            bad_input(path, toml->entries[k].key, "nothing but [[step]]");
        }
    }
    for (unsigned table = 1; table <= toml->tables; table++) {
        struct step step = read_step(toml, table, path);
        if (step.waits) {
            script->signalled[script->signalled_count++] = step;
            continue;
        }
        size_t at = script->count++;
        for (; at > 0 && script->steps[at - 1].at_us > step.at_us; at--) {
            script->steps[at] = script->steps[at - 1];
        }
        script->steps[at] = step;
    }
}
