#include "chip.h"

#include "registers.h"

#define CRYSTAL_MHZ 12u
#define WATCHDOG_US 40000u
#define NOISE_BITS 512u

/* --- clocks --- */

static void wait_until_set(uint32_t address, uint32_t bits) {
    while ((REGISTER(address) & bits) != bits) {
    }
}

/* Starts a PLL at CRYSTAL_MHZ × factor, which must be 750 to 1600 MHz, divided by both dividers. */
static void start_pll(uint32_t pll, uint32_t reset, uint32_t factor, uint32_t divider1, uint32_t divider2) {
    SET(RESETS) = reset;
    CLEAR(RESETS) = reset;
    wait_until_set(RESETS_DONE, reset);
    REGISTER(PLL_CS(pll)) = 1;
    REGISTER(PLL_FBDIV(pll)) = factor;
    CLEAR(PLL_PWR(pll)) = BIT(0) | BIT(5);
    wait_until_set(PLL_CS(pll), BIT(31));
    REGISTER(PLL_PRIM(pll)) = divider1 << 16 | divider2 << 12;
    CLEAR(PLL_PWR(pll)) = BIT(3);
}

/* Timer and watchdog count µs. */
static void start_ticks(void) {
#ifdef RP2350
    static const uint32_t GENERATORS[] = {TICKS_OF_TIMER, TICKS_OF_WATCHDOG};
    for (uint32_t k = 0; k < 2; k++) {
        REGISTER(GENERATORS[k] + 4u) = CRYSTAL_MHZ;
        REGISTER(GENERATORS[k]) = 1;
    }
#else
    REGISTER(WATCHDOG_TICK) = CRYSTAL_MHZ | BIT(9);
#endif
}

/* Reference and timer from the crystal, USB from its own PLL at 48 MHz, all other clocks from the PLL at CLOCK_HZ. */
static void start_clocks(void) {
    REGISTER(XOSC_STARTUP) = 47; /* × 256 cycles: 1 ms */
    REGISTER(XOSC_CTRL) = 0xfabu << 12 | 0xaa0u;
    wait_until_set(XOSC_STATUS, BIT(31));
    REGISTER(CLK_REF_CTRL) = 2;
    wait_until_set(CLK_REF_SELECTED, BIT(2));
    CLEAR(CLK_SYS_CTRL) = 1; /* leave the PLL, which may still run */
    wait_until_set(CLK_SYS_SELECTED, BIT(0));
    start_pll(PLL_SYS, RESET_PLL_SYS, CLOCK_HZ / 1000000u * 12u / CRYSTAL_MHZ, 6, 2);
    start_pll(PLL_USB, RESET_PLL_USB, 1200u / CRYSTAL_MHZ, 5, 5);
    REGISTER(CLK_SYS_CTRL) = 0; /* PLL as source, selected by the next line */
    SET(CLK_SYS_CTRL) = 1;
    wait_until_set(CLK_SYS_SELECTED, BIT(1));
    REGISTER(CLK_PERI_CTRL) = CLK_ENABLE;
    REGISTER(CLK_USB_CTRL) = CLK_ENABLE;
    REGISTER(CLK_ADC_CTRL) = CLK_ENABLE | 3u << 5; /* the crystal, fast enough for a temperature */
    start_ticks();
}

enum reset_cause chip_reset_cause(void) {
    if (REGISTER(WATCHDOG_REASON) & 1u) {
        return RESET_WATCHDOG;
    }
    uint32_t causes = REGISTER(CHIP_RESET);
    if (causes & CHIP_RESET_BROWN_OUT) {
        return RESET_BROWN_OUT;
    }
    return (causes & CHIP_RESET_RUN) ? RESET_RESET : RESET_POWER_UP;
}

/* --- time --- */

uint64_t chip_now_us(void) {
    for (uint32_t high = REGISTER(TIMER_RAW_HIGH);;) {
        uint32_t low = REGISTER(TIMER_RAW_LOW), again = REGISTER(TIMER_RAW_HIGH);
        if (again == high) {
            return (uint64_t)high << 32 | low;
        }
        high = again;
    }
}

void chip_wait_us(uint32_t us) {
    for (uint64_t until_us = chip_now_us() + us + 1; chip_now_us() < until_us;) {
    }
}

void chip_set_alarm(uint64_t at_us) {
    REGISTER(TIMER_ALARM0) = (uint32_t)at_us;
    if (chip_now_us() >= at_us) {
        SET(TIMER_INTF) = 1; /* the alarm compares for equality and would otherwise wait for more than an hour */
    }
}

static void (*alarm_callback)(void);

void timer_isr(void) {
    CLEAR(TIMER_INTF) = 1;
    REGISTER(TIMER_INTR) = 1;
    alarm_callback();
}

void chip_fence(void) { __asm volatile("dsb\n\tisb" ::: "memory"); }

void chip_hold_alarm(void) {
    REGISTER(NVIC_DISABLE(TIMER_IRQ)) = NVIC_BIT(TIMER_IRQ);
    chip_fence();
}

void chip_release_alarm(void) {
    chip_fence();
    REGISTER(NVIC_ENABLE(TIMER_IRQ)) = NVIC_BIT(TIMER_IRQ);
}

/* --- trigger --- */

static uint32_t trigger_pin;
static volatile uint32_t trigger_count, trigger_low;

void trigger_isr(void) {
    trigger_low = REGISTER(TIMER_RAW_LOW);
    CLEAR(IO_ENABLED_EDGES(trigger_pin)) = IO_RISING_EDGE(trigger_pin);
    trigger_count++;
    chip_fence();
}

static void await_edge(void) {
    REGISTER(IO_EDGES(trigger_pin)) = IO_RISING_EDGE(trigger_pin); /* earlier edges */
    SET(IO_ENABLED_EDGES(trigger_pin)) = IO_RISING_EDGE(trigger_pin);
}

void chip_start_trigger(uint32_t pin) {
    trigger_pin = pin;
    REGISTER(NVIC_PRIORITY(TIMER_IRQ)) |= NVIC_SECOND_PRIORITY(TIMER_IRQ);
    REGISTER(NVIC_PRIORITY(UART_IRQ)) |= NVIC_SECOND_PRIORITY(UART_IRQ);
    await_edge();
    REGISTER(NVIC_ENABLE(IO_IRQ)) = NVIC_BIT(IO_IRQ);
}

uint32_t chip_read_triggers(uint64_t *last_us) {
    uint32_t count = trigger_count;
    if (!(REGISTER(IO_ENABLED_EDGES(trigger_pin)) & IO_RISING_EDGE(trigger_pin))) {
        uint64_t now_us = chip_now_us();
        count = trigger_count;
        *last_us = now_us - (uint32_t)((uint32_t)now_us - trigger_low);
        await_edge();
    }
    return count;
}

/* --- sleep: the processor's own timer ends it, so that the loop notices ticks that do not come --- */

void systick_isr(void) {}

static void start_systick(void) {
    REGISTER(SYSTICK_RELOAD) = CLOCK_HZ / 1000000u * CHIP_SLEEP_US - 1u;
    REGISTER(SYSTICK_VALUE) = 0;
    REGISTER(SYSTICK_CTRL) = 7; /* on, with its interrupt, from the processor's clock */
}

void chip_sleep(void) { __asm volatile("wfi" ::: "memory"); }

/* --- watchdog --- */

void chip_start_watchdog(void) {
    REGISTER(PSM_WDSEL) = PSM_ALL_BUT_OSCILLATORS; /* so all pins become inputs */
    chip_feed_watchdog();
    REGISTER(WATCHDOG_CTRL) = BIT(30);
}

void chip_feed_watchdog(void) { REGISTER(WATCHDOG_LOAD) = WATCHDOG_PER_US * WATCHDOG_US; }

/* --- entropy, temperature --- */

static uint64_t entropy_pool;

/* Adds one bit of the ring oscillator's jitter and its sampling time. The multiplier is Knuth's 64-bit constant. */
void chip_collect_entropy(void) {
    uint64_t sample = (REGISTER(ROSC_RANDOM_BIT) & 1u) ^ (uint64_t)REGISTER(TIMER_RAW_LOW) << 1;
    entropy_pool = (entropy_pool ^ sample) * 6364136223846793005u + 1u;
}

uint32_t chip_entropy(void) {
    chip_collect_entropy();
    uint64_t mixed = entropy_pool ^ entropy_pool >> 29;
    mixed *= 0xd6e8feb86659fd93u;
    return (uint32_t)(mixed >> 32);
}

int16_t chip_temperature_dc(void) {
    int32_t uv = (int32_t)((uint64_t)(REGISTER(ADC_RESULT) & 0xfffu) * 3300000u / 4096u);
    return (int16_t)(270 - (uv - 706000) * 10 / 1721); /* 0.706 V at 27 °C, −1.721 mV per °C */
}

/* --- startup --- */

void chip_start(void (*on_alarm)(void)) {
    static const uint32_t USED_BLOCKS = RESET_ADC | RESET_DMA | RESET_IO_BANK0 | RESET_PADS_BANK0 | RESET_PIO0 | RESET_PWM |
                                        RESET_SPI0 | RESET_TIMER | RESET_UART0 | RESET_USB;
    CLEAR(WATCHDOG_CTRL) = BIT(30); /* it may still run */
    alarm_callback = on_alarm;
    start_clocks();
    SET(RESETS) = USED_BLOCKS; /* including the pins, which pull-downs then hold */
    CLEAR(RESETS) = USED_BLOCKS;
    wait_until_set(RESETS_DONE, USED_BLOCKS);
    REGISTER(TIMER_INTE) = 1;
    start_systick();
    REGISTER(ADC_CS) = 1u | BIT(1);
    REGISTER(ADC_CS) = 1u | BIT(1) | BIT(3) | 4u << 12; /* temperature, free-running */
    for (uint32_t k = 0; k < NOISE_BITS; k++) {
        chip_collect_entropy();
        chip_wait_us(1);
    }
}
