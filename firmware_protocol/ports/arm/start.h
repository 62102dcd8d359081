/* Startup code of the Cortex-M ports. */

#ifndef START_H
#define START_H

typedef void (*handler)(void);

/* Initialises memory by the symbols of the linker script (data_stored, data_begin, data_end, bss_begin, bss_end, all
   word-aligned), then runs main. Located in section .start, which the script does not copy. */
void reset(void);
/* Loops until the watchdog resets the chip; handler of all unexpected exceptions. */
void halt(void);

#endif
