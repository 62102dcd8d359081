/* Registers of the RP2040 (data sheet: Raspberry Pi, "RP2040 Datasheet"), used by this port. */

#ifndef REGISTERS_H
#define REGISTERS_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))
/* Aliases of each peripheral register toggle, set or clear the written bits. */
#define SET(address) REGISTER((address) + 0x2000u)
#define CLEAR(address) REGISTER((address) + 0x3000u)
#define BIT(n) (1u << (n))

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
#define RESETS_DONE (RESETS + 0x8u)
#define RESET_ADC BIT(0)
#define RESET_IO_BANK0 BIT(5)
#define RESET_PADS_BANK0 BIT(8)
#define RESET_PLL_SYS BIT(12)
#define RESET_PLL_USB BIT(13)
#define RESET_PWM BIT(14)
#define RESET_SPI0 BIT(16)
#define RESET_TIMER BIT(21)
#define RESET_UART0 BIT(22)
#define RESET_USB BIT(24)

#define CLOCKS 0x40008000u
#define CLK_REF_CTRL (CLOCKS + 0x30u)
#define CLK_REF_SELECTED (CLOCKS + 0x38u)
#define CLK_SYS_CTRL (CLOCKS + 0x3cu)
#define CLK_SYS_SELECTED (CLOCKS + 0x44u)
#define CLK_PERI_CTRL (CLOCKS + 0x48u)
#define CLK_USB_CTRL (CLOCKS + 0x54u)
#define CLK_ADC_CTRL (CLOCKS + 0x60u)
#define CLK_ENABLE BIT(11)

#define XOSC_CTRL 0x40024000u
#define XOSC_STATUS 0x40024004u
#define XOSC_STARTUP 0x4002400cu
#define PLL_SYS 0x40028000u
#define PLL_USB 0x4002c000u
#define PLL_CS(pll) ((pll) + 0x0u)
#define PLL_PWR(pll) ((pll) + 0x4u)
#define PLL_FBDIV(pll) ((pll) + 0x8u)
#define PLL_PRIM(pll) ((pll) + 0xcu)

/* --- watchdog, reset cause --- */
#define PSM_WDSEL 0x40010008u
#define WATCHDOG_CTRL 0x40058000u
#define WATCHDOG_LOAD 0x40058004u
#define WATCHDOG_REASON 0x40058008u
#define WATCHDOG_TICK 0x4005802cu
#define CHIP_RESET 0x40064008u

/* --- pins --- */
#define IO_CTRL(pin) (0x40014004u + 8u * (pin))
#define IO_SPI 1u
#define IO_UART 2u
#define IO_PWM 4u
#define IO_SIO 5u
#define IO_OUT_LOW (2u << 8) /* independent of the peripheral */
#define PAD(pin) (0x4001c004u + 4u * (pin))
#define PAD_SCHMITT BIT(1)
#define PAD_PULL_DOWN BIT(2)
#define PAD_PULL_UP BIT(3)
#define PAD_4_MA (1u << 4)
#define PAD_INPUT BIT(6)
#define SIO_IN 0xd0000004u
#define SIO_OUT_SET 0xd0000014u
#define SIO_OUT_CLEAR 0xd0000018u
#define SIO_OE_SET 0xd0000024u

/* --- UART 0 (Arm PL011), SPI 0 (Arm PL022) --- */
#define UART 0x40034000u
#define UART_DR (UART + 0x00u)
#define UART_FR (UART + 0x18u)
#define UART_IBRD (UART + 0x24u)
#define UART_FBRD (UART + 0x28u)
#define UART_LCR_H (UART + 0x2cu)
#define UART_CR (UART + 0x30u)
#define UART_IFLS (UART + 0x34u)
#define UART_IMSC (UART + 0x38u)
#define UART_ICR (UART + 0x44u)
#define SPI 0x4003c000u
#define SPI_CR0 (SPI + 0x00u)
#define SPI_CR1 (SPI + 0x04u)
#define SPI_DR (SPI + 0x08u)
#define SPI_SR (SPI + 0x0cu)
#define SPI_CPSR (SPI + 0x10u)

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
#define PWM_CSR(slice) (0x40050000u + 0x14u * (slice))
#define PWM_CTR(slice) (0x40050008u + 0x14u * (slice))
#define PWM_CC(slice) (0x4005000cu + 0x14u * (slice))
#define PWM_TOP(slice) (0x40050010u + 0x14u * (slice))
#define TIMER 0x40054000u
#define TIMER_ALARM0 (TIMER + 0x10u)
#define TIMER_RAW_HIGH (TIMER + 0x24u)
#define TIMER_RAW_LOW (TIMER + 0x28u)
#define TIMER_INTR (TIMER + 0x34u)
#define TIMER_INTE (TIMER + 0x38u)
#define TIMER_INTF (TIMER + 0x3cu)
#define ADC_CS 0x4004c000u
#define ADC_RESULT 0x4004c004u
#define ROSC_RANDOM_BIT 0x4006001cu

/* --- the processor --- */
#define SYSTICK_CTRL 0xe000e010u
#define SYSTICK_RELOAD 0xe000e014u
#define SYSTICK_VALUE 0xe000e018u
#define VTOR 0xe000ed08u
#define NVIC_ENABLE 0xe000e100u
#define NVIC_DISABLE 0xe000e180u
#define TIMER_IRQ BIT(0)
#define UART_IRQ BIT(20)

#endif
