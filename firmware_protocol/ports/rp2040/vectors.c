#include "start.h"

extern char stack_top[];
void systick_isr(void), timer_isr(void), uart_isr(void);

__attribute__((section(".vectors"), used)) static const struct {
    void *stack;
    handler handlers[15 + 26];
} vectors = {
    stack_top,
    {reset, halt, halt, 0, 0, 0, 0, 0, 0, 0, halt, 0, 0, halt, systick_isr,
     timer_isr, halt, halt, halt, halt, halt, halt, halt, halt, halt, halt, halt, halt,
     halt, halt, halt, halt, halt, halt, halt, uart_isr, halt, halt, halt, halt, halt},
};
