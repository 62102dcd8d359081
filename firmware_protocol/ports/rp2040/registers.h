/* Registers of the RP2040 and the RP2350 (Raspberry Pi's data sheets), used by this port. */

#ifndef REGISTERS_H
#define REGISTERS_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))
/* Aliases of each peripheral register toggle, set or clear the written bits. */
#define SET(address) REGISTER((address) + 0x2000u)
#define CLEAR(address) REGISTER((address) + 0x3000u)
#define BIT(n) (1u << (n))

#ifdef RP2350
#include "rp2350.h"
#else
#include "rp2040.h"
#endif

/* --- clocks and resets --- */
#define RESETS_DONE (RESETS + 0x8u)
#define CLK_REF_CTRL (CLOCKS + 0x30u)
#define CLK_REF_SELECTED (CLOCKS + 0x38u)
#define CLK_SYS_CTRL (CLOCKS + 0x3cu)
#define CLK_SYS_SELECTED (CLOCKS + 0x44u)
#define CLK_PERI_CTRL (CLOCKS + 0x48u)
#define CLK_ENABLE BIT(11)

#define XOSC_CTRL XOSC
#define XOSC_STATUS (XOSC + 0x4u)
#define XOSC_STARTUP (XOSC + 0xcu)
#define PLL_CS(pll) ((pll) + 0x0u)
#define PLL_PWR(pll) ((pll) + 0x4u)
#define PLL_FBDIV(pll) ((pll) + 0x8u)
#define PLL_PRIM(pll) ((pll) + 0xcu)

/* --- watchdog --- */
#define WATCHDOG_CTRL WATCHDOG
#define WATCHDOG_LOAD (WATCHDOG + 0x4u)
#define WATCHDOG_REASON (WATCHDOG + 0x8u)

/* --- pins --- */
#define IO_CTRL(pin) (IO_BANK0 + 0x4u + 8u * (pin))
#define IO_EDGES(pin) (IO_INTERRUPTS + (pin) / 8u * 4u)             /* written bits are cleared */
#define IO_ENABLED_EDGES(pin) (IO_INTERRUPTS_OF_CORE0 + (pin) / 8u * 4u)
#define IO_RISING_EDGE(pin) BIT((pin) % 8u * 4u + 3u)
#define IO_SPI 1u
#define IO_UART 2u
#define IO_PWM 4u
#define IO_SIO 5u
#define IO_PIO 6u
#define IO_OUT_LOW (2u << 8) /* independent of the peripheral */
#define PAD(pin) (PADS_BANK0 + 0x4u + 4u * (pin))
#define PAD_SCHMITT BIT(1)
#define PAD_PULL_DOWN BIT(2)
#define PAD_PULL_UP BIT(3)
#define PAD_4_MA (1u << 4)
#define PAD_INPUT BIT(6)
#define PAD_OUTPUT_OFF BIT(7)
#define PAD_AFTER_RESET (PAD_SCHMITT | PAD_PULL_DOWN | PAD_4_MA | PAD_INPUT) /* the RP2350 also isolates it */

/* --- UART 0 (Arm PL011), SPI 0 (Arm PL022) --- */
#define UART_DR (UART + 0x00u)
#define UART_FR (UART + 0x18u)
#define UART_IBRD (UART + 0x24u)
#define UART_FBRD (UART + 0x28u)
#define UART_LCR_H (UART + 0x2cu)
#define UART_CR (UART + 0x30u)
#define UART_IFLS (UART + 0x34u)
#define UART_IMSC (UART + 0x38u)
#define UART_ICR (UART + 0x44u)
#define SPI_CR0 (SPI + 0x00u)
#define SPI_CR1 (SPI + 0x04u)
#define SPI_DR (SPI + 0x08u)
#define SPI_SR (SPI + 0x0cu)
#define SPI_CPSR (SPI + 0x10u)

/* --- PIO 0, DMA --- */
#define PIO 0x50200000u
#define PIO_CTRL PIO
#define PIO_TX(machine) (PIO + 0x10u + 0x4u * (machine))
#define PIO_RX(machine) (PIO + 0x20u + 0x4u * (machine))
#define PIO_PROGRAM(k) (PIO + 0x48u + 0x4u * (k))
#define PIO_CLOCK(machine) (PIO + 0xc8u + 0x18u * (machine))
#define PIO_WRAP(machine) (PIO + 0xccu + 0x18u * (machine))
#define PIO_SHIFT(machine) (PIO + 0xd0u + 0x18u * (machine))
#define PIO_EXECUTE(machine) (PIO + 0xd8u + 0x18u * (machine))
#define PIO_PINS(machine) (PIO + 0xdcu + 0x18u * (machine))
#define DMA 0x50000000u
#define DMA_READ(channel) (DMA + 0x00u + 0x40u * (channel))
#define DMA_WRITE(channel) (DMA + 0x04u + 0x40u * (channel))
#define DMA_COUNT(channel) (DMA + 0x08u + 0x40u * (channel))
#define DMA_CTRL_AND_TRIGGER(channel) (DMA + 0x0cu + 0x40u * (channel))
#define DMA_CTRL(channel) (DMA + 0x10u + 0x40u * (channel))
#define DMA_READ_AND_TRIGGER(channel) (DMA + 0x3cu + 0x40u * (channel))
#define DMA_ON (BIT(0) | 2u << 2) /* words of 32 bits */
#define DMA_NEXT_READ BIT(4)
#define DMA_PIO_RX0 4u
#define DMA_ALWAYS 0x3fu

/* --- USB: memory of both sides, controller --- */
#define USB_DPRAM 0x50100000u
#define USB_ENDPOINT_CONTROL(endpoint, out) (USB_DPRAM + 0x8u * (endpoint) + 0x4u * (out)) /* not of endpoint 0 */
#define USB_ENDPOINT_ENABLE (BIT(31) | BIT(29)) /* each buffer shows in USB_BUFFER_STATUS */
#define USB_BUFFER_CONTROL(endpoint, out) (USB_DPRAM + 0x80u + 0x8u * (endpoint) + 0x4u * (out))
#define USB_BUFFER_LENGTH 0x3ffu
#define USB_BUFFER_AVAILABLE BIT(10)
#define USB_BUFFER_STALL BIT(11)
#define USB_BUFFER_DATA1 BIT(13)
#define USB_BUFFER_FULL BIT(15)
#define USB 0x50110000u
#define USB_ADDRESS (USB + 0x00u)
#define USB_MAIN_CTRL (USB + 0x40u)
#define USB_FRAME (USB + 0x48u)
#define USB_SIE_CTRL (USB + 0x4cu)
#define USB_SIE_STATUS (USB + 0x50u)
#define USB_SIE_BUS_RESET BIT(19)
#define USB_SIE_SETUP BIT(17)
#define USB_BUFFER_STATUS (USB + 0x58u)
#define USB_STALL_ARM (USB + 0x68u)
#define USB_MUXING (USB + 0x74u)
#define USB_POWER (USB + 0x78u)

/* --- PWM, timer, temperature, entropy --- */
#define PWM_CSR(slice) (PWM + 0x14u * (slice))
#define PWM_CTR(slice) (PWM + 0x8u + 0x14u * (slice))
#define PWM_CC(slice) (PWM + 0xcu + 0x14u * (slice))
#define PWM_TOP(slice) (PWM + 0x10u + 0x14u * (slice))
#define TIMER_ALARM0 (TIMER + 0x10u)
#define TIMER_RAW_HIGH (TIMER + 0x24u)
#define TIMER_RAW_LOW (TIMER + 0x28u)
#define TIMER_INTR TIMER_INTERRUPTS
#define TIMER_INTE (TIMER_INTERRUPTS + 0x4u)
#define TIMER_INTF (TIMER_INTERRUPTS + 0x8u)
#define ADC_CS ADC
#define ADC_RESULT (ADC + 0x4u)
#define ADC_FCS (ADC + 0x8u)
#define ADC_FIFO (ADC + 0xcu)
#define ADC_DIV (ADC + 0x10u)

/* --- the processor --- */
#define SYSTICK_CTRL 0xe000e010u
#define SYSTICK_RELOAD 0xe000e014u
#define SYSTICK_VALUE 0xe000e018u
#define VTOR 0xe000ed08u
#define NVIC_ENABLE(irq) (0xe000e100u + (irq) / 32u * 4u)
#define NVIC_DISABLE(irq) (0xe000e180u + (irq) / 32u * 4u)
#define NVIC_BIT(irq) BIT((irq) % 32u)
#define NVIC_PRIORITY(irq) (0xe000e400u + (irq) / 4u * 4u)
#define NVIC_SECOND_PRIORITY(irq) (0x40u << (irq) % 4u * 8u)
#define TIMER_IRQ 0u

#endif
