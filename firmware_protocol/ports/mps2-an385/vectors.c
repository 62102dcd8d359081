#include "start.h"

extern char stack_top[];
void uart0_isr(void), uart1_isr(void), uart2_isr(void), timer0_isr(void);

__attribute__((section(".vectors"), used)) static const struct {
    void *stack;
    handler handlers[15 + 9];
} vectors = {
    stack_top,
    {reset, halt, halt, halt, halt, halt, 0, 0, 0, 0, halt, halt, 0, halt, halt,
     uart0_isr, halt, uart1_isr, halt, uart2_isr, halt, halt, halt, timer0_isr},
};
