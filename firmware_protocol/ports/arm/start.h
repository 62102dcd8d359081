/* What Cortex-M ports share: the way from reset to main. */

#ifndef START_H
#define START_H

typedef void (*handler)(void);

/* Copies and clears memory as the linker script says (data_stored, data_begin, data_end, bss_begin, bss_end, all at
   whole words), then runs main. Stands in section .start, which a script keeps out of what is copied. */
void reset(void);
/* Does nothing for ever: the watchdog's business. For vectors that should never be taken. */
void halt(void);

#endif
