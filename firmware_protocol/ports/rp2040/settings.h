/* Settings of this board: its limits, which no host can loosen. `optodrive board settings` writes those of a display. */

#ifndef SETTINGS_H
#define SETTINGS_H

#include "chip.h"

#define HOST_BAUD 1000000u
#define GATE_HZ 50000u /* PWM frequency of the duty, within the bandwidth of the laser driver */
#ifndef BOARD_UID
#define BOARD_UID {'r', 'p', '2', '0', '4', '0', '-', '0', '0', '0', '0', '1'}
#endif

static const struct board_config SETTINGS = {
    .limits =
        {
            .max_on_us = 50000,
            .max_duty = 65535,
            .mean_duty = 65535,
            .spot_uj = 150000,
            .spot_leak_uw = 1400000,
            .full_power_uw = 2450000,
            .x_min = 0,
            .x_max = 65535,
            .y_min = 0,
            .y_max = 65535,
            .settle_us = 190,
            .settle_ns_per_code = 50,
            .rest_us = 500,
            .lease_ms = 100,
        },
    .uid = BOARD_UID,
    .firmware = FIRMWARE,
    .cell_codes = 1300,
    .queue_points = BOARD_QUEUE_POINTS,
    .cells = BOARD_CELLS,
    .window_pulses = BOARD_PULSES,
    .key_edge = true,
    .interface = INTERFACE_ANALOG,
    .feedback_codes = 0,
};

#endif
