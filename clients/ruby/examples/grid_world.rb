# A walk to the corner of a grid, as a millrace worker: ruby grid_world.rb ADDRESS [NAME]
require_relative "../millrace"

class GridWorld
  ID = "GridWorld-v0"
  SIZE = 5
  SHAPE, LOW, HIGH = [2], 0.0, 1.0 # an observation: x and y
  ACTIONS = 4 # right, left, up, down
  TIME_LIMIT = 30 # steps of an episode
  MOVES = [[1, 0], [-1, 0], [0, 1], [0, -1]].freeze

  def reset(seed)
    @random = seed ? Random.new(seed) : @random || Random.new
    @x, @y, @steps = @random.rand(SIZE), @random.rand(SIZE - 1), 0 # never the goal
    observation
  end

  # Returns the observation, the reward, whether the goal is reached, and whether the time is over.
  def step(action)
    @x, @y = [@x, @y].zip(MOVES[action]).map { |at, by| (at + by).clamp(0, SIZE - 1) }
    @steps += 1
    [observation, -1.0, [@x, @y] == [SIZE - 1, SIZE - 1], @steps == TIME_LIMIT]
  end

  def observation = [@x.fdiv(SIZE - 1), @y.fdiv(SIZE - 1)]
end

exit Worker.new(ARGV[0], GridWorld, ARGV[1] || "grid-#{Process.pid}").run if __FILE__ == $PROGRAM_NAME
