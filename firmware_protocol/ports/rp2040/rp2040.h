/* What differs between the RP2040 and the RP2350: addresses of the RP2040. */

#ifndef RP2040_H
#define RP2040_H

/* --- flash: boot2 only --- */
#define SSI 0x18000000u
#define SSI_CTRLR0 (SSI + 0x00u)
#define SSI_CTRLR1 (SSI + 0x04u)
#define SSI_SSIENR (SSI + 0x08u)
#define SSI_SER (SSI + 0x10u)
#define SSI_BAUDR (SSI + 0x14u)
#define SSI_SPI_CTRLR0 (SSI + 0xf4u)

/* --- clocks and resets --- */
#define RESETS 0x4000c000u
#define RESET_ADC BIT(0)
#define RESET_DMA BIT(2)
#define RESET_IO_BANK0 BIT(5)
#define RESET_PADS_BANK0 BIT(8)
#define RESET_PIO0 BIT(10)
#define RESET_PLL_SYS BIT(12)
#define RESET_PLL_USB BIT(13)
#define RESET_PWM BIT(14)
#define RESET_SPI0 BIT(16)
#define RESET_TIMER BIT(21)
#define RESET_UART0 BIT(22)
#define RESET_USB BIT(24)
#define CLOCKS 0x40008000u
#define CLK_USB_CTRL (CLOCKS + 0x54u)
#define CLK_ADC_CTRL (CLOCKS + 0x60u)
#define XOSC 0x40024000u
#define PLL_SYS 0x40028000u
#define PLL_USB 0x4002c000u

/* --- watchdog, reset cause --- */
#define PSM_WDSEL 0x40010008u
#define PSM_ALL_BUT_OSCILLATORS 0x1fffcu
#define WATCHDOG 0x40058000u
#define WATCHDOG_TICK (WATCHDOG + 0x2cu) /* of the timer, too */
#define WATCHDOG_PER_US 2u               /* erratum E1 */
#define CHIP_RESET 0x40064008u
#define CHIP_RESET_RUN BIT(16)
#define CHIP_RESET_BROWN_OUT 0u /* not reported */

/* --- peripherals --- */
#define IO_BANK0 0x40014000u
#define IO_INTERRUPTS (IO_BANK0 + 0xf0u)
#define IO_INTERRUPTS_OF_CORE0 (IO_BANK0 + 0x100u)
#define PADS_BANK0 0x4001c000u
#define SIO_IN 0xd0000004u
#define SIO_OUT_SET 0xd0000014u
#define SIO_OUT_CLEAR 0xd0000018u
#define SIO_OE_SET 0xd0000024u
#define UART 0x40034000u
#define SPI 0x4003c000u
#define PWM 0x40050000u
#define TIMER 0x40054000u
#define TIMER_INTERRUPTS (TIMER + 0x34u)
#define ADC 0x4004c000u
#define ROSC_RANDOM_BIT 0x4006001cu

/* --- fields of a DMA channel's control --- */
#define DMA_NEXT_WRITE BIT(5)
#define DMA_WRITE_RING(bits) (BIT(10) | (bits) << 6)
#define DMA_CHAIN(channel) ((uint32_t)(channel) << 11)
#define DMA_REQUEST(source) ((source) << 15)
#define DMA_ADC 36u

/* --- interrupts --- */
#define IO_IRQ 13u
#define UART_IRQ 20u
#define IRQS 26u

#endif
