#include "outputs.h"

#include "chip.h"
#include "pins.h"
#include "registers.h"
#include "settings.h"
#include "xy2_100.h"

#define GATE_PERIOD (CLOCK_HZ / GATE_HZ)
/* A period of PWM has 256 steps or more, and the readback holds from one to the next: docs/how-to/wire-a-board.md. */
_Static_assert(GATE_HZ >= 30000u && GATE_PERIOD >= 256u, "GATE_HZ: 30,000 to 488,000");

#define GATE_FORCED_LOW (IO_PWM | IO_OUT_LOW)

/* --- pins --- */

void outputs_set(uint32_t pin, bool high) { REGISTER(high ? SIO_OUT_SET : SIO_OUT_CLEAR) = BIT(pin); }

bool outputs_get(uint32_t pin) { return REGISTER(SIO_IN) >> pin & 1u; }

/* Connects a pin that floats since the reset, in this order. */
static void connect(uint32_t pin, uint32_t function) {
    REGISTER(IO_CTRL(pin)) = function;
    REGISTER(PAD(pin)) = PAD_AFTER_RESET;
}

static void configure_output(uint32_t pin, bool high) {
    outputs_set(pin, high);
    REGISTER(SIO_OE_SET) = BIT(pin);
    connect(pin, IO_SIO);
}

static void configure_input(uint32_t pin, uint32_t pull) {
    REGISTER(PAD(pin)) = PAD_INPUT | PAD_SCHMITT | PAD_4_MA | pull;
    REGISTER(IO_CTRL(pin)) = IO_SIO;
}

/* --- gate --- */

/* Off is forced at the pin, behind the PWM. A stopped PWM slice applies its new level immediately. */
void outputs_set_gate(bool on, uint16_t duty) {
    REGISTER(IO_CTRL(PIN_GATE)) = GATE_FORCED_LOW;
    REGISTER(PWM_CSR(GATE_SLICE)) = 0;
    if (!on) {
        return;
    }
    REGISTER(PWM_CTR(GATE_SLICE)) = 0;
    REGISTER(PWM_CC(GATE_SLICE)) = duty * GATE_PERIOD / 65535u; /* rounded down */
    REGISTER(PWM_CSR(GATE_SLICE)) = 1;
    REGISTER(IO_CTRL(PIN_GATE)) = IO_PWM;
}

/* --- mirrors: XY2-100, or a DAC8563, which samples data at the clock's falling edge --- */

static void write_dac(uint8_t command, uint16_t value) {
    outputs_set(PIN_DAC_SYNC, false);
    REGISTER(SPI_DR) = command;
    REGISTER(SPI_DR) = value >> 8;
    REGISTER(SPI_DR) = value & 0xffu;
    while (REGISTER(SPI_SR) & BIT(4)) {
    }
    outputs_set(PIN_DAC_SYNC, true);
}

void outputs_move_mirrors(enum interface interface, uint16_t x, uint16_t y) {
    if (interface == INTERFACE_XY2_100) {
        xy2_100_move(x, y);
        return;
    }
    write_dac(0x00, x);
    write_dac(0x11, y); /* updates both outputs */
}

static void start_dac(void) {
    configure_output(PIN_DAC_SYNC, true);
    connect(PIN_DAC_CLOCK, IO_SPI);
    connect(PIN_DAC_DATA, IO_SPI);
    REGISTER(SPI_CPSR) = 2;
    REGISTER(SPI_CR0) = 2u << 8 | BIT(7) | 7u; /* 125 MHz / 2 / 3, mode 1, 8 bits */
    REGISTER(SPI_CR1) = BIT(1);
    write_dac(0x28, 1); /* software reset: both outputs at mid-scale */
    write_dac(0x38, 1); /* internal reference, 2.5 V */
    write_dac(0x02, 3); /* gain 1: 0 to 2.5 V */
    write_dac(0x30, 3); /* ignore the pin LDAC */
}

static void start_xy2_100(void) {
    configure_input(PIN_XY2_STATUS, PAD_PULL_DOWN); /* a broken wire is a frame without control bits */
    xy2_100_start();
    for (uint32_t pin = PIN_XY2_CLOCK; pin <= PIN_XY2_Y; pin++) {
        connect(pin, IO_PIO);
    }
}

/* --- startup --- */

void outputs_start(enum interface interface) {
    connect(PIN_GATE, GATE_FORCED_LOW);
    REGISTER(PWM_TOP(GATE_SLICE)) = GATE_PERIOD - 1u;
    configure_output(PIN_RELAY, false);
    configure_output(PIN_INDICATOR, false);
    configure_output(PIN_TICK, false);
    configure_input(PIN_INTERLOCK, PAD_PULL_DOWN); /* a broken wire is low: unsafe */
    configure_input(PIN_KEY, PAD_PULL_DOWN);
    configure_input(PIN_ESTOP, PAD_PULL_DOWN);
    configure_input(PIN_READBACK, PAD_PULL_UP); /* a broken wire reads as gate on */
    configure_input(PIN_TRIGGER, PAD_PULL_DOWN);
    configure_input(PIN_HOST_CLOSED, PAD_PULL_UP); /* a broken wire reads as a closed port */
    configure_input(PIN_HOST_RX, PAD_PULL_UP);
    REGISTER(IO_CTRL(PIN_HOST_RX)) = IO_UART;
    connect(PIN_HOST_TX, IO_UART);
    if (interface == INTERFACE_XY2_100) {
        start_xy2_100();
    } else {
        start_dac();
    }
}
