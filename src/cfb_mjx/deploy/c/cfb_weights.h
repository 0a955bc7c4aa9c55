/* Weights that can be replaced without flashing: a set in flash, the exported one, and a set in memory.
 *
 * A set is what weights.bin holds. It is written into memory in parts; until it is complete and has been checked, the
 * set in flash flies. Little-endian processors only: elsewhere every set is refused. One caller at a time.
 */
#ifndef CFB_WEIGHTS_H
#define CFB_WEIGHTS_H

#include <stdint.h>

#include "cfb_data.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
  uint32_t magic, version;
  uint32_t architecture; /* hash of all that is computed with but the numbers */
  uint32_t count;        /* of the numbers */
  uint32_t crc;          /* CRC-32 of the four before it and the numbers */
  float numbers[CFB_SET_COUNT]; /* the four outputs of a hover, then weights and biases */
} cfb_weights_t;

/* What has become of the set in memory. */
typedef enum {
  CFB_WEIGHTS_NONE,         /* nothing was written */
  CFB_WEIGHTS_UNCHECKED,    /* written, at least in part */
  CFB_WEIGHTS_GOOD,         /* fits, and is complete and finite */
  CFB_WEIGHTS_INCOMPLETE,   /* parts are missing */
  CFB_WEIGHTS_FORMAT,       /* it is no set of weights, or of another version */
  CFB_WEIGHTS_ARCHITECTURE, /* it is for another network or observation */
  CFB_WEIGHTS_CRC,          /* its CRC is another: damaged on the way */
  CFB_WEIGHTS_NOT_FINITE,   /* a number is infinite or no number */
} cfb_weights_status_t;

/* Write a part of a set, from byte offset on; parts may come in any order. From the first part on the set in flash
 * flies. 0: beyond the end, nothing was written. */
int cfb_weights_write(uint32_t offset, const void *bytes, uint32_t length);

/* Check the set in memory; flies nothing. Takes some milliseconds on the drone after something was written. */
cfb_weights_status_t cfb_weights_check(void);

/* What has become of it so far; checks nothing. */
cfb_weights_status_t cfb_weights_status(void);

/* Check it, and if it is good fly it, after a cfb_policy_reset(). */
cfb_weights_status_t cfb_weights_apply(void);

/* Fly the set in flash, after a cfb_policy_reset() if another flew. */
void cfb_weights_unload(void);

/* Whether the set in memory flies, and the CRC of the set that flies. */
int cfb_weights_loaded(void);
uint32_t cfb_weights_crc(void);

/* For the policy: the network that flies, and the outputs that its history begins with. */
const cfb_network_t *cfb_weights_network(void);
const float *cfb_weights_hover(void);

/* The set in memory, and the network with its weights. */
extern cfb_weights_t cfb_written;
extern const cfb_network_t cfb_loaded;

#ifdef __cplusplus
}
#endif

#endif
