/* Settings of the board: limits and identity, by default as those of the simulated board. */

#include <stdlib.h>
#include <string.h>

#include "host.h"

#define FIRMWARE 0x00010000u

void settings_default(struct board_config *config) {
    *config = (struct board_config){
        .limits = {.max_on_us = 50000,
                   .max_duty = 65535,
                   .mean_duty = 65535,
                   .spot_uj = 150000,
                   .spot_leak_uw = 1400000,
                   .full_power_uw = 2450000,
                   .x_min = 0,
                   .x_max = 65535,
                   .y_min = 0,
                   .y_max = 65535,
                   .settle_us = 200,
                   .settle_ns_per_code = 50,
                   .rest_us = 500,
                   .lease_ms = 100},
        .firmware = FIRMWARE,
        .cell_codes = 1300,
        .queue_points = 4096,
        .cells = 2048,
        .window_pulses = BOARD_PULSES,
    };
    memcpy(config->uid, "host board 1", sizeof config->uid);
}

static uint32_t read_integer(const char *path, const struct toml_entry *entry, long long low, long long high) {
    if (entry->kind != TOML_INTEGER || entry->integer < low || entry->integer > high) {
        char where[300], expected[80];
        snprintf(where, sizeof where, "%s: %s", path, entry->key);
        snprintf(expected, sizeof expected, "a whole number from %lld to %lld", low, high);
        bad_input(where, entry->raw, expected);
    }
    return (uint32_t)entry->integer;
}

static void read_uid(struct board_config *config, const char *path, const struct toml_entry *entry) {
    char where[300];
    snprintf(where, sizeof where, "%s: uid", path);
    if (entry->kind != TOML_STRING || strlen(entry->text) != 24 ||
        strspn(entry->text, "0123456789abcdefABCDEF") != 24) {
        bad_input(where, entry->raw, "24 hexadecimal digits");
    }
    for (size_t k = 0; k < sizeof config->uid; k++) {
        char byte[3] = {entry->text[2 * k], entry->text[2 * k + 1], 0};
        config->uid[k] = (uint8_t)strtoul(byte, NULL, 16);
    }
}

static uint8_t read_interface(const char *path, const struct toml_entry *entry) {
    if (entry->kind == TOML_STRING && strcmp(entry->text, "xy2-100") == 0) {
        return INTERFACE_XY2_100;
    }
    if (entry->kind != TOML_STRING || strcmp(entry->text, "analog") != 0) {
        char where[300];
        snprintf(where, sizeof where, "%s: interface", path);
        bad_input(where, entry->raw, "analog or xy2-100");
    }
    return INTERFACE_ANALOG;
}

static bool read_entry(struct board_config *config, const char *path, const struct toml_entry *entry) {
#define READ(name, bits, at, way) \
    if (strcmp(entry->key, #name) == 0) { \
        config->limits.name = (uint##bits##_t)read_integer(path, entry, 0, UINT##bits##_MAX); \
        return true; \
    }
    LIMITS_FIELDS(READ)
#undef READ
    if (strcmp(entry->key, "cell_codes") == 0) {
        config->cell_codes = (uint16_t)read_integer(path, entry, 1, UINT16_MAX);
    } else if (strcmp(entry->key, "queue_points") == 0) {
        config->queue_points = (uint16_t)read_integer(path, entry, DATA_ITEMS_MAX, BOARD_QUEUE_POINTS);
    } else if (strcmp(entry->key, "cells") == 0) {
        config->cells = (uint16_t)read_integer(path, entry, 1, BOARD_CELLS);
    } else if (strcmp(entry->key, "window_pulses") == 0) {
        config->window_pulses = (uint16_t)read_integer(path, entry, 1, BOARD_PULSES);
    } else if (strcmp(entry->key, "feedback_codes") == 0) {
        config->feedback_codes = (uint16_t)read_integer(path, entry, 0, UINT16_MAX);
    } else if (strcmp(entry->key, "uid") == 0) {
        read_uid(config, path, entry);
    } else if (strcmp(entry->key, "key_edge") == 0) {
        if (entry->kind != TOML_BOOLEAN) {
            char where[300];
            snprintf(where, sizeof where, "%s: key_edge", path);
            bad_input(where, entry->raw, "true or false");
        }
        config->key_edge = entry->boolean;
    } else if (strcmp(entry->key, "interface") == 0) {
        config->interface = read_interface(path, entry);
    } else {
        return false;
    }
    return true;
}

void settings_read(struct board_config *config, const char *path) {
    static struct toml read;
    struct toml *toml = &read;
    toml_read(toml, path);
    for (size_t k = 0; k < toml->count; k++) {
        if (toml->entries[k].table || !read_entry(config, path, &toml->entries[k])) {
#define NAME(name, bits, at, way) #name ", "
            bad_input(path, toml->entries[k].key,
                      "a known key: one of " LIMITS_FIELDS(NAME) "uid, cell_codes, queue_points, cells, window_pulses, key_edge, "
                      "interface, feedback_codes");
        }
    }
    if (toml->tables) {
        bad_input(path, "[[step]]", "no tables");
    }
}
