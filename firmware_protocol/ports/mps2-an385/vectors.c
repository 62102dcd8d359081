#include "start.h"

extern char stack_top[];
void uart0_came(void), uart1_came(void), uart2_came(void), timer0_ticked(void);

__attribute__((section(".vectors"), used)) static const struct {
    void *stack;
    handler handlers[15 + 9];
} vectors = {
    stack_top,
    {reset, stuck, stuck, stuck, stuck, stuck, 0, 0, 0, 0, stuck, stuck, 0, stuck, stuck,
     uart0_came, stuck, uart1_came, stuck, uart2_came, stuck, stuck, stuck, timer0_ticked},
};
