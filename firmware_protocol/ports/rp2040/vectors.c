#include "registers.h"
#include "start.h"

#define FIRST_IRQ 15u

extern char stack_top[];
void systick_isr(void), timer_isr(void), trigger_isr(void), uart_isr(void);

__attribute__((section(".vectors"), used)) static const struct {
    void *stack;
    handler handlers[FIRST_IRQ + IRQS];
} vectors = {
    stack_top,
    {reset, halt, halt, 0, 0, 0, 0, 0, 0, 0, halt, 0, 0, halt, systick_isr,
     [FIRST_IRQ + TIMER_IRQ] = timer_isr,
     [FIRST_IRQ + TIMER_IRQ + 1u ... FIRST_IRQ + IO_IRQ - 1u] = halt,
     [FIRST_IRQ + IO_IRQ] = trigger_isr,
     [FIRST_IRQ + IO_IRQ + 1u ... FIRST_IRQ + UART_IRQ - 1u] = halt,
     [FIRST_IRQ + UART_IRQ] = uart_isr,
     [FIRST_IRQ + UART_IRQ + 1u ... FIRST_IRQ + IRQS - 1u] = halt},
};
