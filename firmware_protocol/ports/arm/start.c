#include "start.h"

#include <stdint.h>

extern uint32_t data_begin[], data_end[], bss_begin[], bss_end[];
extern const uint32_t data_stored[];
extern int main(void) __attribute__((long_call)); /* it may be among what is copied, far away */

__attribute__((section(".start"))) void halt(void) {
    for (;;) {
    }
}

__attribute__((section(".start"))) void reset(void) {
    /* volatile: else the compiler calls memcpy, which may not be there before it is copied. */
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
