/* Gate, relay, indicator and mirrors. */

#ifndef OUTPUTS_H
#define OUTPUTS_H

#include <stdbool.h>
#include <stdint.h>

#include "board.h"

/* Initialises the outputs: gate off, relay open, mirrors at the centre by their interface. */
void outputs_start(enum interface interface);
void outputs_set_gate(bool on, uint16_t duty);
void outputs_move_mirrors(enum interface interface, uint16_t x, uint16_t y);
void outputs_set(uint32_t pin, bool high);
bool outputs_get(uint32_t pin);

#endif
