/* A network that flies to the target. See cfb_pilot.h. */
//@hold
#include <stddef.h>
//@end
//@previews
#include <string.h>
//@end

#include "cfb_data.h"
#include "cfb_pilot.h"
//@previews
#include "cfb_policy.h"
//@end
//@loadable
#include "cfb_weights.h"
//@end

static cfb_memory_t memory;
//@fixed
static const float hover[4] = CFB_HOVER_OUTPUTS;
//@end
//@previews
static float preview[3 * CFB_POLICY_PREVIEWS];
static const float times[] = CFB_PREVIEW_TIMES;

void cfb_policy_set_preview(const float ahead[3 * CFB_POLICY_PREVIEWS]) { memcpy(preview, ahead, sizeof preview); }

float cfb_policy_preview_time(int i) { return times[i]; }

void cfb_pilot_reset(void) { memset(preview, 0, sizeof preview); }
//@end
//@hold
void cfb_pilot_reset(void) {}
//@end

void cfb_pilot_start(const cfb_estimate_t *estimate) {
  cfb_network_start(@HOLDER@, &memory, estimate, @HOVER@);
}

void cfb_pilot_command(const cfb_estimate_t *estimate, float command[4]) {
//@previews
  cfb_network_command(@HOLDER@, &memory, estimate, preview, command);
//@end
//@hold
  cfb_network_command(@HOLDER@, &memory, estimate, NULL, command);
//@end
  cfb_network_remember(@HOLDER@, &memory, estimate, command);
}
