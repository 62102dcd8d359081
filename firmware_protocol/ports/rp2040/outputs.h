/* Gate, relay, indicator and mirrors. */

#ifndef OUTPUTS_H
#define OUTPUTS_H

#include <stdbool.h>
#include <stdint.h>

/* Initialises the outputs: gate off, relay open, DAC ready. */
void outputs_start(void);
void outputs_set_gate(bool on, uint16_t duty);
void outputs_move_mirrors(uint16_t x, uint16_t y);
void outputs_set(uint32_t pin, bool high);
bool outputs_get(uint32_t pin);

#endif
