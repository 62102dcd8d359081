#include "feedback.h"

#include "pins.h"
#include "registers.h"

#define READINGS 4u /* of each axis: 40 µs */
#define AXES 2u
#define ADC_PERIOD 240u /* cycles at 48 MHz: a reading every 5 µs, the axes in turn */
#define RING_BITS 5u    /* 8 words */

/* The circuit maps ±5 V, codes 0 to 65535, to 1.65 ± 1.35 V, so a step of the ADC's 4096 in 3.3 V is 19.556 codes; this is
   half of it, in 1/1024, because two readings add up. */
#define CODES_PER_HALF_STEP 10013
#define CENTRE_READINGS 4096

static volatile uint32_t readings[READINGS * AXES] __attribute__((aligned(4 * READINGS * AXES)));

enum { EVEN_ROUNDS = 3, ODD_ROUNDS }; /* channels of the DMA, of which 0 to 2 are those of xy2_100.c */

/* Each fills the ring once, and starts the other one: without end. */
static void start_dma(void) {
    for (uint32_t channel = EVEN_ROUNDS; channel <= ODD_ROUNDS; channel++) {
        REGISTER(DMA_READ(channel)) = ADC_FIFO;
        REGISTER(DMA_WRITE(channel)) = (uint32_t)readings;
        REGISTER(DMA_COUNT(channel)) = READINGS * AXES;
        uint32_t other = channel == EVEN_ROUNDS ? ODD_ROUNDS : EVEN_ROUNDS;
        uint32_t control =
            DMA_ON | DMA_NEXT_WRITE | DMA_WRITE_RING(RING_BITS) | DMA_CHAIN(other) | DMA_REQUEST(DMA_ADC);
        REGISTER(channel == EVEN_ROUNDS ? DMA_CTRL(channel) : DMA_CTRL_AND_TRIGGER(channel)) = control;
    }
}

void feedback_start(void) {
    REGISTER(CLK_ADC_CTRL) = 0;
    REGISTER(CLK_ADC_CTRL) = CLK_ENABLE; /* of the PLL for USB, 48 MHz: a reading takes 2 µs */
    for (uint32_t pin = PIN_FEEDBACK_X; pin <= PIN_FEEDBACK_Y; pin++) {
        REGISTER(PAD(pin)) = PAD_OUTPUT_OFF; /* neither pulled nor read as a level */
    }
    REGISTER(ADC_CS) = 1u; /* ends the readings of the temperature */
    while (!(REGISTER(ADC_CS) & BIT(8))) {
    }
    REGISTER(ADC_DIV) = (ADC_PERIOD - 1u) << 8;
    REGISTER(ADC_FCS) = 1u << 24 | BIT(3) | BIT(0); /* requests the DMA for each reading */
    start_dma();
    REGISTER(ADC_CS) = 3u << 16 | BIT(3) | 1u; /* inputs 0 and 1 in turn, from 0 on */
}

/* Code by the two readings in the middle of four. */
static int32_t read_axis(uint32_t axis) {
    uint32_t sum = 0, low = UINT32_MAX, high = 0;
    for (uint32_t k = axis; k < READINGS * AXES; k += AXES) {
        uint32_t reading = readings[k] & 0xfffu;
        sum += reading;
        low = reading < low ? reading : low;
        high = reading > high ? reading : high;
    }
    return 32768 + ((int32_t)(sum - low - high) - CENTRE_READINGS) * CODES_PER_HALF_STEP / 1024;
}

void feedback_read(int32_t *x, int32_t *y) {
    *x = read_axis(0);
    *y = read_axis(1);
}
