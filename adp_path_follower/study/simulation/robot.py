"""The simulated robot as settings say it is, where no simulator node runs."""

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.settings.schema import flatten, setting_fields
from sim_unicycle.fault_script import FaultScript, read_fault_script
from sim_unicycle.settings import PlantSettings, SimulatorSettings


def without_nodes(settings: SimulatorSettings) -> tuple[PlantSettings, FaultScript]:
    """Return the parts of the simulator's settings that a simulation without ROS uses.

    Raises FileError if the fault script cannot be read, and SettingsError for anything that only
    the simulator node can do.
    """
    script = read_fault_script(settings.simulation.fault_script)
    message_fault = script.changes_messages()
    if message_fault:
        raise SettingsError(
            f"fault_script changes '{message_fault}', but there are no messages here: give it to "
            "adp demo"
        )
    values, plain = flatten(settings), flatten(SimulatorSettings())
    for field in setting_fields(SimulatorSettings):
        taken = field.group == "plant" or field.name == "fault_script"
        if not taken and values[field.name] != plain[field.name]:
            raise SettingsError(
                f"setting '{field.name}' is of the simulator node, which does not run here: leave "
                "it out, or use adp demo"
            )
    return settings.plant, script
