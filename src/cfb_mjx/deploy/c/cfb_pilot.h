/* What flies: a network that holds a target, or one that flips and returns. */
#ifndef CFB_PILOT_H
#define CFB_PILOT_H

#include "cfb_network.h"

/* Begin anew: it has hovered at this estimate for long. */
void cfb_pilot_start(const cfb_estimate_t *estimate);

/* The command that is due; called once every step. */
void cfb_pilot_command(const cfb_estimate_t *estimate, float command[4]);

/* What cfb_policy_reset() stands for here, before any estimate is known. */
void cfb_pilot_reset(void);

#endif
