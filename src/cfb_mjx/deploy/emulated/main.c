/* Flies given estimates through the policy on an emulated STM32F405, and says what it commanded and how many
 * instructions that took. Runs on bare metal; talks through ARM semihosting.
 */
#include <stdint.h>

#include "cfb_policy.h"
#include "inputs.h" /* generated: STEPS, FLIP_SPEED, FLIP_RATE, FLIPS, inputs[STEPS][INPUTS] */

#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010u)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014u)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xE000E018u)
#define COPROCESSORS (*(volatile uint32_t *)0xE000ED88u)

extern uint32_t stack_top[], data_begin[], data_end[], data_image[], bss_begin[], bss_end[];
int main(void);
void start(void);
static void trap(void);

__attribute__((section(".vectors"), used)) static void *const vectors[16] = {
    (void *)stack_top, (void *)start, (void *)trap, (void *)trap, (void *)trap, (void *)trap, (void *)trap,
};

static void semihost(int operation, const void *argument) {
  register int r0 __asm__("r0") = operation;
  register const void *r1 __asm__("r1") = argument;
  __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}

static void leave(void) {
  semihost(0x18, (const void *)0x20026); /* SYS_EXIT, ADP_Stopped_ApplicationExit */
  for (;;) {
  }
}

static void trap(void) {
  semihost(0x04, "trap\n");
  leave();
}

static void say(const char *what, uint32_t value) {
  static const char digits[] = "0123456789abcdef";
  char text[10];
  for (int i = 0; i < 8; i++) text[i] = digits[(value >> (28 - 4 * i)) & 15u];
  text[8] = '\n';
  text[9] = 0;
  semihost(0x04, what); /* SYS_WRITE0 */
  semihost(0x04, text);
}

void start(void) {
  const uint32_t *from = data_image;
  for (uint32_t *to = data_begin; to < data_end; to++) *to = *from++;
  for (uint32_t *to = bss_begin; to < bss_end; to++) *to = 0;
  COPROCESSORS |= 0xFu << 20;
  __asm__ volatile("dsb\nisb");
  main();
  leave();
}

/* Two instructions a turn: what the clock makes of a known number of them. */
__attribute__((noinline)) static void known(uint32_t turns) {
  __asm__ volatile("1: subs %0, #1\n bne 1b" : "+r"(turns) : : "cc");
}

static uint32_t now(void) { return SYSTICK_VALUE; }
static uint32_t since(uint32_t then) { return (then - SYSTICK_VALUE) & 0xFFFFFFu; }

int main(void) {
  SYSTICK_RELOAD = 0xFFFFFFu;
  SYSTICK_VALUE = 0;
  SYSTICK_CONTROL = 5; /* on, processor clock */

  uint32_t then = now();
  known(500000);
  say("known ", since(then));

  cfb_policy_reset();
#if FLIPS
  cfb_policy_set_flip(FLIP_SPEED, FLIP_RATE);
#endif
  for (int i = 0; i < STEPS; i++) {
    union {
      float number;
      uint32_t bits;
    } command[4];
    float u[4];
    const float *const row = inputs[i];
    then = now();
#if INPUTS > 16
    cfb_policy_set_preview(row + 16);
#endif
    cfb_policy_step(row, row + 3, row + 6, row + 10, row + 13, u);
    const uint32_t ticks = since(then);
    for (int motor = 0; motor < 4; motor++) {
      command[motor].number = u[motor];
      say("u ", command[motor].bits);
    }
    say("ticks ", ticks);
  }
  return 0;
}
