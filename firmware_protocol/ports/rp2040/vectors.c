#include "start.h"

extern char stack_top[];
void timer_came(void), uart_came(void);

__attribute__((section(".vectors"), used)) static const struct {
    void *stack;
    handler handlers[15 + 26];
} vectors = {
    stack_top,
    {reset, stuck, stuck, 0, 0, 0, 0, 0, 0, 0, stuck, 0, 0, stuck, stuck,
     timer_came, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck,
     stuck, stuck, stuck, stuck, stuck, stuck, stuck, uart_came, stuck, stuck, stuck, stuck, stuck},
};
