from sb3_uav.plots.anytime import plot_anytime
from sb3_uav.plots.learning_curves import plot_learning_curves
from sb3_uav.plots.schedule_map import MapPanel, plot_schedule, plot_schedules

__all__ = ["MapPanel", "plot_anytime", "plot_learning_curves", "plot_schedule", "plot_schedules"]
