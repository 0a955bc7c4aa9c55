/* See cfb_weights.h. */
#include "cfb_weights.h"

#include <stddef.h>
#include <string.h>

#include "cfb_policy.h"

cfb_weights_t cfb_written;
static cfb_weights_status_t status;
static int loaded;

cfb_weights_status_t cfb_weights_status(void) { return status; }

int cfb_weights_loaded(void) { return loaded; }

uint32_t cfb_weights_crc(void) { return loaded ? cfb_written.crc : CFB_SET_CRC; }

const cfb_network_t *cfb_weights_network(void) { return loaded ? &cfb_loaded : &cfb_holder; }

const float *cfb_weights_hover(void) {
  static const float hover[4] = CFB_HOVER_OUTPUTS;
  return loaded ? cfb_written.numbers : hover;
}

void cfb_weights_unload(void) {
  if (!loaded) return;
  loaded = 0;
  cfb_policy_reset();
}

int cfb_weights_write(uint32_t offset, const void *bytes, uint32_t length) {
  if (offset > sizeof cfb_written || length > sizeof cfb_written - offset) return 0;
  cfb_weights_unload();
  /* The first part of a set: so that missing parts are seen, and are not those of the set before. */
  if (status != CFB_WEIGHTS_UNCHECKED) memset(&cfb_written, 0xff, sizeof cfb_written);
  status = CFB_WEIGHTS_UNCHECKED;
  memcpy((unsigned char *)&cfb_written + offset, bytes, length);
  return 1;
}

/* Whether one of these words was not written. Its bits, all ones, are no number. */
static int missing(const void *words, uint32_t count) {
  for (uint32_t i = 0; i < count; i++) {
    uint32_t bits;
    memcpy(&bits, (const unsigned char *)words + 4 * i, sizeof bits);
    if (bits == 0xffffffffu) return 1;
  }
  return 0;
}

/* By their bits, which no compiler option makes disappear. */
static int all_finite(const float *values, uint32_t count) {
  for (uint32_t i = 0; i < count; i++) {
    uint32_t bits;
    memcpy(&bits, &values[i], sizeof bits);
    if ((bits & 0x7f800000u) == 0x7f800000u) return 0;
  }
  return 1;
}

/* CRC-32 as in zlib, bit by bit: a table would cost a kilobyte. */
static uint32_t checksum(uint32_t crc, const void *bytes, size_t length) {
  const unsigned char *at = bytes;
  for (; length > 0; length--) {
    crc ^= *at++;
    for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ (0xedb88320u & (0u - (crc & 1u)));
  }
  return crc;
}

static cfb_weights_status_t judged(void) {
  const cfb_weights_t *const set = &cfb_written;
  const size_t head = offsetof(cfb_weights_t, crc);
  if (missing(set, 5)) return CFB_WEIGHTS_INCOMPLETE;
  if (set->magic != CFB_SET_MAGIC || set->version != CFB_SET_VERSION) return CFB_WEIGHTS_FORMAT;
  if (set->architecture != CFB_SET_ARCHITECTURE || set->count != CFB_SET_COUNT) return CFB_WEIGHTS_ARCHITECTURE;
  if (missing(set->numbers, CFB_SET_COUNT)) return CFB_WEIGHTS_INCOMPLETE;
  const uint32_t crc = checksum(checksum(0xffffffffu, set, head), set->numbers, sizeof set->numbers);
  if (~crc != set->crc) return CFB_WEIGHTS_CRC;
  return all_finite(set->numbers, CFB_SET_COUNT) ? CFB_WEIGHTS_GOOD : CFB_WEIGHTS_NOT_FINITE;
}

cfb_weights_status_t cfb_weights_check(void) {
  if (status == CFB_WEIGHTS_UNCHECKED) status = judged();
  return status;
}

cfb_weights_status_t cfb_weights_apply(void) {
  if (cfb_weights_check() == CFB_WEIGHTS_GOOD) {
    loaded = 1;
    cfb_policy_reset();
  }
  return status;
}
