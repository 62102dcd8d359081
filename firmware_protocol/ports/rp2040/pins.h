/* Pin assignment of the Pico, GPIO numbers; docs/how-to/wire-a-board.md shows the circuit. */

#ifndef PINS_H
#define PINS_H

#define PIN_HOST_TX 0u     /* to the adapter's RXD */
#define PIN_HOST_RX 1u     /* from the adapter's TXD */
#define PIN_HOST_CLOSED 2u /* from the adapter's DTR#: low while a program has the port open */
#define PIN_ESTOP 8u       /* high while the emergency stop is not pressed */
#define PIN_KEY 9u         /* high while the key is on */
#define PIN_INTERLOCK 10u  /* high while the interlock is closed */
#define PIN_INDICATOR 11u
#define PIN_RELAY 12u
#define PIN_READBACK 13u   /* high while the driver's input permits emission */
#define PIN_GATE 14u       /* PWM slice 7, channel A */
#define GATE_SLICE 7u
#define PIN_DAC_SYNC 17u
#define PIN_DAC_CLOCK 18u
#define PIN_DAC_DATA 19u
#define PIN_XY2_CLOCK 16u  /* of XY2-100; the four follow each other */
#define PIN_XY2_SYNC 17u
#define PIN_XY2_X 18u
#define PIN_XY2_Y 19u
#define PIN_XY2_STATUS 21u
#define PIN_TRIGGER 20u    /* a rising edge starts the job that awaits it */
#define PIN_FEEDBACK_X 26u /* input 0 of the ADC, measured position of the mirrors; the two follow each other */
#define PIN_FEEDBACK_Y 27u
#define PIN_TICK 22u       /* high while the tick runs, for an oscilloscope */

#endif
