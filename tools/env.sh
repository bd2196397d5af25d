# Source this to work with flexarm in a shell: . tools/env.sh   (sh, bash, dash, zsh)
# It adds .venv, the workspace and, unless the system has ROS, the wheels' ROS to the paths.

if [ -n "${BASH_VERSION:-}" ]; then
  FLEXARM_ROOT=$(CDPATH='' cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
elif [ -n "${ZSH_VERSION:-}" ]; then
  eval 'FLEXARM_ROOT=${${(%):-%x}:A:h:h}'
elif [ -z "${FLEXARM_ROOT:-}" ]; then
  FLEXARM_ROOT=$(pwd -P) # other shells do not report where a sourced file is
fi

if [ ! -f "$FLEXARM_ROOT/install/local_setup.sh" ] || [ ! -f "$FLEXARM_ROOT/.venv/flexarm.mode" ]; then
  echo "flexarm: nothing built in $FLEXARM_ROOT; run \`make build\` there (in a plain sh, set FLEXARM_ROOT first)" >&2
  return 1
fi
export FLEXARM_ROOT

_flexarm_mode=$(cat "$FLEXARM_ROOT/.venv/flexarm.mode")
if [ "$_flexarm_mode" = wheels ]; then
  if [ -n "${ROS_DISTRO:-}" ]; then # another ROS, overridden by FLEXARM_ROS=wheels: the two must not be mixed
    unset ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION PYTHONPATH LD_LIBRARY_PATH
    unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH
  fi
  case ":${AMENT_PREFIX_PATH:-}:" in
    *":$FLEXARM_ROOT/.venv:"*) ;;
    *) export AMENT_PREFIX_PATH="$FLEXARM_ROOT/.venv${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}" ;;
  esac
  case ":${CMAKE_PREFIX_PATH:-}:" in
    *":$FLEXARM_ROOT/.venv:"*) ;;
    *) export CMAKE_PREFIX_PATH="$FLEXARM_ROOT/.venv${CMAKE_PREFIX_PATH:+:$CMAKE_PREFIX_PATH}" ;;
  esac
  # If another environment's Python has set it, ours would not find its libraries.
  unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
  _flexarm_setup=local_setup.sh # there is no underlying workspace whose setup.sh to chain
else
  _flexarm_setup=setup.sh
fi

case ":$PATH:" in
  ":$FLEXARM_ROOT/.venv/bin:"*) ;;
  *) export PATH="$FLEXARM_ROOT/.venv/bin:$PATH" ;;
esac

# colcon's scripts read variables that are not set.
_flexarm_flags=$-
set +u
COLCON_CURRENT_PREFIX="$FLEXARM_ROOT/install"
. "$FLEXARM_ROOT/install/$_flexarm_setup"
unset COLCON_CURRENT_PREFIX
case $_flexarm_flags in *u*) set -u ;; esac

export PYTHONNOUSERSITE=1
# By default an arm's topics stay on this machine.
export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
unset _flexarm_mode _flexarm_setup _flexarm_flags
