#include "start.h"

extern char stack_top[];
void watchdog_isr(void);

__attribute__((section(".vectors"), used)) static const struct {
    void *stack;
    handler handlers[15];
} vectors = {
    stack_top,
    {reset, watchdog_isr, halt, halt, halt, halt, 0, 0, 0, 0, halt, halt, 0, halt, halt},
};
