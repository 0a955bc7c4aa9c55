/* A network that holds the target. See cfb_pilot.h. */
#include <stddef.h>

#include "cfb_data.h"
#include "cfb_pilot.h"

static cfb_memory_t memory;

void cfb_pilot_reset(void) {}

void cfb_pilot_start(const cfb_estimate_t *estimate) {
  cfb_network_start(&cfb_holder, &memory, estimate, CFB_HOVER_COMMAND);
}

void cfb_pilot_command(const cfb_estimate_t *estimate, float command[4]) {
  cfb_network_command(&cfb_holder, &memory, estimate, NULL, command);
  cfb_network_remember(&cfb_holder, &memory, estimate, command);
}
