from sb3_uav.evaluation.run import evaluate
from sb3_uav.evaluation.summary import SummaryRow
from sb3_uav.evaluation.table import print_table

__all__ = ["SummaryRow", "evaluate", "print_table"]
