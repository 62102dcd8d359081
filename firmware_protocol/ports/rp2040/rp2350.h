/* What differs between the RP2040 and the RP2350: addresses of the RP2350. */

#ifndef RP2350_H
#define RP2350_H

/* --- clocks and resets --- */
#define RESETS 0x40020000u
#define RESET_ADC BIT(0)
#define RESET_DMA BIT(2)
#define RESET_IO_BANK0 BIT(6)
#define RESET_PADS_BANK0 BIT(9)
#define RESET_PIO0 BIT(11)
#define RESET_PLL_SYS BIT(14)
#define RESET_PLL_USB BIT(15)
#define RESET_PWM BIT(16)
#define RESET_SPI0 BIT(18)
#define RESET_TIMER BIT(23)
#define RESET_UART0 BIT(26)
#define RESET_USB BIT(28)
#define CLOCKS 0x40010000u
#define CLK_USB_CTRL (CLOCKS + 0x60u)
#define CLK_ADC_CTRL (CLOCKS + 0x6cu)
#define XOSC 0x40048000u
#define PLL_SYS 0x40050000u
#define PLL_USB 0x40058000u

/* --- watchdog, reset cause --- */
#define PSM_WDSEL 0x40018008u
#define PSM_ALL_BUT_OSCILLATORS 0x1fffff3u
#define WATCHDOG 0x400d8000u
#define TICKS_OF_TIMER 0x40108018u
#define TICKS_OF_WATCHDOG 0x40108030u
#define WATCHDOG_PER_US 1u
#define CHIP_RESET 0x4010002cu
#define CHIP_RESET_RUN BIT(18)
#define CHIP_RESET_BROWN_OUT BIT(17)

/* --- peripherals --- */
#define IO_BANK0 0x40028000u
#define IO_INTERRUPTS (IO_BANK0 + 0x230u)
#define IO_INTERRUPTS_OF_CORE0 (IO_BANK0 + 0x248u)
#define PADS_BANK0 0x40038000u
#define SIO_IN 0xd0000004u
#define SIO_OUT_SET 0xd0000018u
#define SIO_OUT_CLEAR 0xd0000020u
#define SIO_OE_SET 0xd0000038u
#define UART 0x40070000u
#define SPI 0x40080000u
#define PWM 0x400a8000u
#define TIMER 0x400b0000u
#define TIMER_INTERRUPTS (TIMER + 0x3cu)
#define ADC 0x400a0000u
#define ROSC_RANDOM_BIT 0x400e8020u

/* --- fields of a DMA channel's control --- */
#define DMA_NEXT_WRITE BIT(6)
#define DMA_WRITE_RING(bits) (BIT(12) | (bits) << 8)
#define DMA_CHAIN(channel) ((uint32_t)(channel) << 13)
#define DMA_REQUEST(source) ((source) << 17)
#define DMA_ADC 48u

/* --- interrupts --- */
#define IO_IRQ 21u
#define UART_IRQ 33u
#define IRQS 52u

#endif
