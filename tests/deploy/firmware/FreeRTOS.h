#include "stabilizer_types.h"
