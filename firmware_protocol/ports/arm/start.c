#include "start.h"

#include <stdint.h>

extern uint32_t data_begin[], data_end[], bss_begin[], bss_end[];
extern const uint32_t data_stored[];
extern int main(void) __attribute__((long_call)); /* it may be in the copied section, out of branch range */

__attribute__((section(".start"))) void halt(void) {
    for (;;) {
    }
}

__attribute__((section(".start"))) void reset(void) {
    /* volatile prevents a call of memcpy, which may itself be in the section to copy. */
    const volatile uint32_t *from = data_stored;
    for (volatile uint32_t *to = data_begin; to < data_end;) {
        *to++ = *from++;
    }
    for (volatile uint32_t *to = bss_begin; to < bss_end;) {
        *to++ = 0;
    }
    main();
    halt();
}
